#!/bin/sh
# Run a command that opens windows, on the existing display or on a virtual display.
# usage: sh scripts/headless.sh COMMAND [ARGUMENT...]

if [ -n "${DISPLAY:-}${WAYLAND_DISPLAY:-}" ] || [ "$(uname -s)" != Linux ]; then
    exec "$@"
fi
if command -v xvfb-run >/dev/null && command -v xauth >/dev/null; then
    # xvfb-run writes its own messages to the same stream as the errors of the command.
    exec xvfb-run --auto-servernum --server-args="-screen 0 1600x1100x24" "$@"
fi
echo "There is no display, and xvfb-run is not installed, so tests that open windows are skipped." >&2
echo "To run these tests: sudo apt-get install xvfb xauth" >&2
exec "$@"
