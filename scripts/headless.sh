#!/bin/sh
# Run a command that opens windows: on the display that is there, or on a virtual one.
# usage: sh scripts/headless.sh COMMAND [ARGUMENT...]

if [ -n "${DISPLAY:-}${WAYLAND_DISPLAY:-}" ] || [ "$(uname -s)" != Linux ]; then
    exec "$@"
fi
if command -v xvfb-run >/dev/null && command -v xauth >/dev/null; then
    # xvfb-run sends what it has to say itself to the same place as the command's errors.
    exec xvfb-run --auto-servernum --server-args="-screen 0 1600x1100x24" "$@"
fi
echo "No display, and no xvfb-run to make one: what opens windows cannot run, and its tests are" >&2
echo "skipped. To have them too: sudo apt-get install xvfb xauth" >&2
exec "$@"
