#!/usr/bin/env bash
# Sets up this checkout: a virtual environment with the pinned packages, and a GL library to render with.
# The Makefile calls it before every target; a second call with nothing changed takes milliseconds.
#
#   scripts/setup.sh           the virtual environment
#   scripts/setup.sh gl        that, and a GL library (make demo, make test)
#
# PYTHON       the Python that makes the environment (default python3)
# VENV         where it is made (default .venv)
# TORCH_INDEX  the package index that torch, and nothing else, comes from, where the default one would bring a build that
#              does not fit the machine (see the Makefile)
# MUJOCO_GL    egl or osmesa, where only that one is wanted; 'disable' skips the check for a GL library
# pip's own settings (PIP_*, pip.conf) are respected as they are.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

python=${PYTHON:-python3}
venv=${VENV:-.venv}

say() { echo "setup: $*"; }
die() {
    echo "setup: $*" >&2
    exit 1
}

# --- system packages -------------------------------------------------------------------------------------------------

# apt_install PACKAGE...: installs Debian packages where that needs no password; false where it cannot.
apt_install() {
    local as_root=()
    command -v apt-get >/dev/null || return 1
    if [[ $(id -u) != 0 ]]; then
        sudo -n true 2>/dev/null || return 1
        as_root=(sudo -n)
    fi
    say "installing Debian packages: $*"
    # An update may fail for one stale source and still leave what is needed.
    "${as_root[@]}" apt-get update -qq </dev/null || true
    "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive \
        apt-get install -y -qq --no-install-recommends "$@" </dev/null >/dev/null
}

# --- the virtual environment -----------------------------------------------------------------------------------------

make_venv() {
    # The package itself runs on 3.10, too. Of the pinned set, numpy asks for 3.11, and labmaze has no wheel for 3.13.
    local wanted="Python 3.11 or 3.12 is needed for the pinned packages; name one with PYTHON=/path/to/python"
    command -v "$python" >/dev/null || die "no '$python' found: $wanted"
    "$python" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))' ||
        die "'$python' is $("$python" -V): $wanted"
    # Debian ships venv without ensurepip, and that in a package of its own.
    if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        local package
        package="$("$python" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])')"
        if ! { apt_install "$package" && "$python" -c 'import ensurepip, venv' 2>/dev/null; }; then
            die "$python cannot make virtual environments: as root, run 'apt-get install $package', then run this again"
        fi
    fi
    say "making $venv with $("$python" -V)"
    "$python" -m venv --clear "$venv"
}

# What the environment was made from: it is made anew, or updated, when any of this changes.
fingerprint() {
    {
        pwd
        "$venv/bin/python" -V
        cat setup.cfg pyproject.toml constraints.txt sb3_dreamer_urlb/version.txt scripts/setup.sh
    } | cksum
}

# Torch alone comes from TORCH_INDEX: pip would ask a further index for every package, and wait for each where it is down.
install_torch() {
    say "torch from $TORCH_INDEX"
    "${pip[@]}" install --quiet --no-deps --index-url "$TORCH_INDEX" --retries 2 --timeout 15 -c constraints.txt torch ||
        die "no torch from TORCH_INDEX=$TORCH_INDEX (above: why): is the address right, and can this machine reach it?" \
            "Without TORCH_INDEX, torch comes from pip's own index"
}

install_packages() {
    local pip=("$venv/bin/python" -m pip --disable-pip-version-check)
    say "installing the pinned packages (some 2.6 GB on the disk with torch for CPUs; three to five minutes the first time)"
    [[ -z ${TORCH_INDEX:-} ]] || install_torch
    if [[ -z ${TORCH_INDEX:-} && $(uname -s) == Linux ]] && ! command -v nvidia-smi >/dev/null &&
        ! "${pip[@]}" install -qq --dry-run --no-index --no-deps -c constraints.txt torch 2>/dev/null; then
        say "no NVIDIA GPU is seen; should pip now fetch several GB of CUDA packages, stop it and give the same command with" \
            "TORCH_INDEX=https://download.pytorch.org/whl/cpu"
    fi
    if [[ -t 1 ]]; then
        "${pip[@]}" install -c constraints.txt -e '.[dev,plots,zoo]'
    else
        # A log wants a line for each thing that takes its time, and no bars.
        "${pip[@]}" install --progress-bar off -c constraints.txt -e '.[dev,plots,zoo]' |
            awk '/^ *(Downloading|Building|Installing collected)/ { sub(/^ */, ""); print "setup: " substr($0, 1, 100); fflush() }'
    fi
}

setup_python() {
    # An environment that was moved, or cut off while it was made, is made anew.
    if ! [[ -x $venv/bin/python && -f $venv/.location && $(<"$venv/.location") == "$PWD" ]]; then
        make_venv
        pwd >"$venv/.location"
    fi
    local now
    now=$(fingerprint)
    if ! [[ -f $venv/.installed && $(<"$venv/.installed") == "$now" ]]; then
        install_packages
        say "done: $venv/bin/python has all of it"
        echo "$now" >"$venv/.installed"
    fi
}

# --- the GL library --------------------------------------------------------------------------------------------------

# renders BACKEND: does dm_control draw a picture with it? In a process of its own, for a GL library may also abort.
renders() {
    MUJOCO_GL=$1 "$venv/bin/python" - >/dev/null 2>&1 <<'PYTHON'
from dm_control import mujoco

world = "<mujoco><worldbody><light pos='0 0 2'/><geom type='sphere' size='.3'/></worldbody></mujoco>"
physics = mujoco.Physics.from_xml_string(world)
assert physics.render(64, 64).any()
physics.free()
PYTHON
}

any_renders() {
    local backend
    for backend in ${MUJOCO_GL:-egl osmesa}; do
        if renders "$backend"; then
            say "rendering with $backend"
            return 0
        fi
    done
    return 1
}

setup_gl() {
    local gl_packages=(libegl1 libopengl0 libgl1-mesa-dri) wanted=${MUJOCO_GL:-any}
    case $wanted in
        disable | disabled | off | false | 0) return ;; # MuJoCo's words for no rendering
        osmesa) gl_packages=(libosmesa6) ;;
    esac
    [[ $(uname -s) == Linux ]] || return 0 # elsewhere the system brings its own
    if [[ -f $venv/.renders && $(<"$venv/.renders") == "$wanted" ]]; then
        return
    fi
    if ! any_renders; then
        say "no GL library to render with ($wanted)"
        if ! { apt_install "${gl_packages[@]}" && any_renders; }; then
            die "cannot render: as root, run 'apt-get install ${gl_packages[*]}' (Debian, Ubuntu) or install EGL or OSMesa" \
                "as your system has it, then run this again"
        fi
    fi
    echo "$wanted" >"$venv/.renders"
}

# one_at_a_time: waits for another make that is setting up the same checkout. Without flock, which macOS lacks, nobody waits.
one_at_a_time() {
    command -v flock >/dev/null || return 0
    mkdir -p "$(dirname "$venv")"
    exec 9>"${venv%/}.lock"
    if ! flock -n 9; then
        say "another make is setting up this checkout; waiting for it"
        flock 9
    fi
}

one_at_a_time
case ${1:-python} in
    python) setup_python ;;
    gl)
        setup_python
        setup_gl
        ;;
    *) die "usage: scripts/setup.sh [python|gl]" ;;
esac
