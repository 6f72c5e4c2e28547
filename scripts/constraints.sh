#!/usr/bin/env bash
# Makes constraints.txt anew: the newest releases that setup.cfg's ranges admit, in a fresh virtual environment.
# torch stays at the version the file names, so that a new one is a deliberate step: TORCH=2.14.0 make constraints
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

python=${PYTHON:-python3}
torch=${TORCH:-$(sed -n 's/^torch==//p' constraints.txt)}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

"$python" -m venv "$work/venv"
pip=("$work/venv/bin/python" -m pip --disable-pip-version-check)
[[ -z ${TORCH_INDEX:-} ]] || "${pip[@]}" install --quiet --no-deps --index-url "$TORCH_INDEX" "torch==$torch"
"${pip[@]}" install --quiet "torch==$torch" -e ".[all]"
"${pip[@]}" check

{
    echo "# The exact set that is tested, made by 'make constraints' on $("$work/venv/bin/python" -V), Linux $(uname -m), CPU:"
    echo "# a fresh virtual environment, 'pip install torch==$torch .[all]', 'pip freeze' without this package."
    echo "# torch carries no local tag (+cpu), so that the CPU and the CUDA builds both fit; a CUDA build brings its own"
    echo "# nvidia-* and triton packages, which are left out here. For Python 3.11 and 3.12 (numpy, labmaze)."
    echo "# Use: pip install -c constraints.txt -e '.[dev,plots,zoo]'   (that is what 'make test' and 'make demo' do)"
    "${pip[@]}" freeze --exclude-editable |
        grep -viE '^(nvidia-|cuda-|triton==|pip==|wheel==)' |
        sed -E 's/^(torch==[^+]*)\+.*/\1/'
} >"$work/constraints.txt"
cp "$work/constraints.txt" constraints.txt
echo "constraints.txt: $(grep -vc '^#' constraints.txt) packages"
