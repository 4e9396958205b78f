"""Set-up of the system packages and the virtual environment that the Makefile requires.

The script installs the system libraries that OpenGL and Qt load: on Debian and Ubuntu the packages
in `SYSTEM`; on other systems, it only prints their names. It also creates the virtual environment
`.venv` with this checkout and the packages of its tests, its documentation and its report. It does
nothing if everything is installed. The script itself requires only Python.

    python3 scripts/setup.py                 # with the versions of constraints.txt
    python3 scripts/setup.py --newest        # with the newest versions; updates constraints.txt
    python3 scripts/setup.py --for-windows   # fails if libraries of Qt are still missing
    python3 scripts/setup.py --for-report    # also installs CalculiX, for the validation report
"""

import ctypes
import glob
import hashlib
import os
import platform
import re
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
PYTHON = VENV / "bin" / "python"
PIP = [str(PYTHON), "-m", "pip", "--disable-pip-version-check"]
STAMP = VENV / "made-from"
CONSTRAINTS = ROOT / "constraints.txt"
#: This checkout, with the extras of pyproject.toml that the commands of the Makefile need.
CHECKOUT = ["--editable", f"{ROOT}[dev,docs,report]"]
OLDEST = (3, 11)
VERSION = "{}.{}".format(*sys.version_info)

#: Requirements, with the Debian package of each requirement. A name with ".so." is a library to
#: load, a name with a slash is a pattern of a file, and any other name is a command.
SYSTEM = (
    # OpenGL: the loader libraries, and Mesa, which has a software rasteriser.
    ("libEGL.so.1", "libegl1"),
    ("libGL.so.1", "libgl1"),
    ("libEGL_mesa.so.0", "libegl-mesa0"),
    ("libGLX_mesa.so.0", "libglx-mesa0"),
    ("/usr/lib*/*/dri/swrast_dri.so", "libgl1-mesa-dri"),
    # Libraries that Qt loads to open a window on X11.
    ("libglib-2.0.so.0", "libglib2.0-0"),
    ("libfontconfig.so.1", "libfontconfig1"),
    ("libdbus-1.so.3", "libdbus-1-3"),
    ("libX11-xcb.so.1", "libx11-xcb1"),
    ("libxkbcommon-x11.so.0", "libxkbcommon-x11-0"),
    ("libxcb-cursor.so.0", "libxcb-cursor0"),
    ("libxcb-icccm.so.4", "libxcb-icccm4"),
    ("libxcb-image.so.0", "libxcb-image0"),
    ("libxcb-keysyms.so.1", "libxcb-keysyms1"),
    ("libxcb-randr.so.0", "libxcb-randr0"),
    ("libxcb-render-util.so.0", "libxcb-render-util0"),
    ("libxcb-shape.so.0", "libxcb-shape0"),
    ("libxcb-shm.so.0", "libxcb-shm0"),
    ("libxcb-sync.so.1", "libxcb-sync1"),
    ("libxcb-xfixes.so.0", "libxcb-xfixes0"),
    # Virtual display for machines without a display.
    ("Xvfb", "xvfb"),
    ("xauth", "xauth"),
)
VIRTUAL_DISPLAY = {"Xvfb", "xauth"}
#: Optional requirement of the validation report.
FOR_REPORT = (("ccx", "calculix-ccx"),)
#: Option of pip and uv that hides their progress, which is for terminals.
QUIET = [] if sys.stderr.isatty() else ["--quiet"]


def say(text):
    """Print a text immediately, so that it precedes the output of programs that run later."""
    print(text, file=sys.stderr, flush=True)


def is_there(need):
    """Return whether a library, a file or a command is on this machine."""
    if "/" in need:
        return bool(glob.glob(need))
    if ".so." not in need:
        return shutil.which(need) is not None
    try:
        ctypes.CDLL(need)
    except OSError:
        return False
    return True


def missing(wanted=SYSTEM):
    """Return the requirements that this machine lacks, with their Debian packages."""
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    lacks = [
        (need, package)
        for need, package in wanted
        if not (display and need in VIRTUAL_DISPLAY) and not is_there(need)
    ]
    if not can_make_environments():
        lacks.append(("ensurepip", f"python{VERSION}-venv"))
    return dict(lacks)


def can_make_environments():
    """Return whether this Python can create virtual environments with pip (Debian's may not)."""
    probe = [sys.executable, "-c", "import ensurepip, venv"]
    return subprocess.call(probe, stderr=subprocess.DEVNULL) == 0


def become_root():
    """Return the prefix that runs a command as root without a password, or None."""
    if os.geteuid() == 0:
        return []
    if shutil.which("sudo") and quiet(["sudo", "-n", "true"]):
        return ["sudo", "-n"]
    return None


def quiet(command):
    """Run a command without printing its output; return whether it succeeded."""
    return subprocess.call(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) == 0


def provide_system(wanted=SYSTEM):
    """Install missing system packages, or print how to; return what is still missing."""
    lacks = missing(wanted) if platform.system() == "Linux" else {}
    if not lacks:
        return {}
    packages = " ".join(lacks.values())
    by_hand = f"sudo apt-get update && sudo apt-get install -y {packages}"
    root = become_root()
    if not shutil.which("apt-get"):
        say(f"Missing on this system, for OpenGL and Qt: {', '.join(lacks)}.")
        say(f"Install them with the package manager. Their Debian packages are {packages}.")
    elif root is None:
        say("System packages are missing. Run this command, and then the same make command again:")
        say(f"    {by_hand}")
    else:
        say(f"Installing system packages: {packages}")
        apt_get(root, ["update"], by_hand)
        apt_get(root, ["install", "--no-install-recommends", *lacks.values()], by_hand)
        return missing(wanted)
    return lacks


def apt_get(root, arguments, by_hand):
    """Run apt-get as root. If it fails, print its output and continue."""
    command = [*root, "env", "DEBIAN_FRONTEND=noninteractive", "apt-get", "-q", "-y"]
    command += ["-o", "DPkg::Lock::Timeout=120", "-o", "Dpkg::Use-Pty=0", *arguments]
    done = subprocess.run(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    if done.returncode:
        say(done.stdout)
        say(f"`apt-get {arguments[0]}` failed (see above). If it fails again, run: {by_hand}")


def environment_key():
    """Return a digest of the requirements of the environment, to detect changes."""
    import json
    import tomllib

    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    parts = [project["build-system"], project["project"], project["tool"]["hatch"]]
    parts.append(CONSTRAINTS.read_text(encoding="utf-8") if CONSTRAINTS.exists() else "")
    # An environment becomes invalid if its folder is moved or the version of Python changes.
    parts += [str(ROOT), VERSION]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def provide_environment(newest):
    """Create or update the virtual environment."""
    made_from = STAMP.read_text() if STAMP.exists() else None
    if not newest and made_from == environment_key() and venv_works():
        return
    if not can_make_environments():
        say("This Python cannot create virtual environments, but the set-up requires one.")
        say(f"On Debian and Ubuntu, install the package python{VERSION}-venv.")
        sys.exit(1)
    say(f"Setting up {VENV.name} (once; some minutes, about 1.5 GB) ...")
    if newest or not venv_works():
        shutil.rmtree(VENV, ignore_errors=True)
        subprocess.check_call([sys.executable, "-m", "venv", str(VENV)])
    STAMP.unlink(missing_ok=True)
    if newest or not CONSTRAINTS.exists():
        subprocess.check_call([*PIP, "install", *QUIET, *CHECKOUT])
    elif install([*CHECKOUT, "--constraint", str(CONSTRAINTS)]):
        say("Some versions of constraints.txt are not available; installing the newest instead.")
        subprocess.check_call([*PIP, "install", *QUIET, *CHECKOUT])
    if newest:
        write_constraints()
    STAMP.write_text(environment_key())


def venv_works():
    """Return whether the environment exists and has this version of Python."""
    check = f"import sys; sys.exit('%d.%d' % sys.version_info[:2] != '{VERSION}')"
    return PYTHON.exists() and quiet([str(PYTHON), "-c", check])


def install(wanted):
    """Install with uv, which is four times as fast as pip, or with pip; return the exit status."""
    uv = find_uv()
    if uv and not subprocess.call([*uv, "pip", "install", *QUIET, "--python", PYTHON, *wanted]):
        return 0
    return subprocess.call([*PIP, "install", *QUIET, *wanted])


def find_uv():
    """Install uv into the environment, and return its command, or None if pip must be used.

    uv does not read the settings of pip, so it is not used if these settings name an index.
    """
    settings = subprocess.run([*PIP, "config", "list"], capture_output=True, text=True)
    if settings.returncode or re.search(r"\.(index-url|no-index)=", settings.stdout):
        return None
    pinned = ["--constraint", str(CONSTRAINTS)] if CONSTRAINTS.exists() else []
    return [str(PYTHON), "-m", "uv"] if quiet([*PIP, "install", *pinned, "uv"]) else None


def write_constraints():
    """Write the installed versions to constraints.txt."""
    frozen = subprocess.check_output([*PIP, "freeze", "--exclude-editable"], text=True)
    head = "# The versions the tests were last run with; written by `make constraints`.\n"
    CONSTRAINTS.write_text(head + frozen, encoding="utf-8")


def main():
    """Run the set-up."""
    if sys.version_info < OLDEST:
        say("Python {}.{} or later is needed; this is {}.".format(*OLDEST, VERSION))
        say("If a later version is installed, name it: make test PYTHON=python3.12")
        sys.exit(1)
    try:
        with ThreadPoolExecutor(1) as pool:
            system = pool.submit(provide_system)
            if not can_make_environments():
                system.result()  # a system package provides this
            provide_environment(newest="--newest" in sys.argv[1:])
            lacks = system.result()
        if "--for-report" in sys.argv[1:]:
            provide_system(FOR_REPORT)
    except subprocess.CalledProcessError as error:
        say(f"The set-up failed: {' '.join(str(part) for part in error.cmd)}")
        say("See the error above. The next make command tries again.")
        sys.exit(1)
    if "--for-windows" in sys.argv[1:] and not VIRTUAL_DISPLAY.issuperset(lacks):
        say("Qt cannot open a window without the missing libraries (see above).")
        sys.exit(1)


if __name__ == "__main__":
    main()
