#!/bin/bash
# What 'make system-test' runs: our drivers against software that others wrote. README.md beside this file says more.
set -euo pipefail
cd "$(dirname "$(realpath "$0")")/../.."
python=${PYTHON:-.venv/bin/python}
share=${XDG_CACHE_HOME:-$HOME/.cache}/otolith-vm/share

[ "$(id -u)" = 0 ] || { echo "system-test needs root, as it makes a guest: sudo make system-test" >&2; exit 2; }
missing=()
command -v linux.uml >/dev/null || missing+=(user-mode-linux)
command -v mmdebstrap >/dev/null || missing+=(mmdebstrap)
command -v mkfs.ext4 >/dev/null || missing+=(e2fsprogs)
command -v gcc >/dev/null || missing+=(gcc libc6-dev)
[ -e /usr/include/modbus/modbus.h ] || missing+=(libmodbus-dev)
[ ${#missing[@]} = 0 ] || { echo "missing on this computer: apt install ${missing[*]}" >&2; exit 2; }

begun=$SECONDS
PYTHON=$python tests/vm/image.sh >/dev/null
echo "guest ready after $((SECONDS - begun)) s"
begun=$SECONDS code=0
"$python" -m pytest -v -s tests/vm/test_modbus.py tests/vm/test_month.py || code=1
mkdir -p "$share"
rm -f "$share"/*.whl
"$python" -m pip --disable-pip-version-check wheel --quiet --no-deps --wheel-dir "$share" .

# The same disk through a first boot, a reboot, and a power cut.
work=$(mktemp -d)
trap 'rm -rf --one-file-system "$work"' EXIT
export SHARE=$share DISK=$work/disk
boot() { tests/vm/run.sh "$@" || code=1; }
SECONDS_AT_MOST=1800 boot tests/vm/in_guest.sh tests/vm/test_can.py tests/vm/test_unit.py \
  tests/vm/test_network.py tests/vm/test_life.py tests/vm/test_troubles.py tests/vm/test_boots.py::test_before_a_reboot
boot tests/vm/in_guest.sh tests/vm/test_boots.py::test_after_a_reboot '&&' python -m tests.vm.cut_power
boot tests/vm/in_guest.sh tests/vm/test_boots.py::test_after_a_power_cut
echo "system tests took $((SECONDS - begun)) s"
exit $code
