#!/bin/bash
# What 'make system-test' runs: our drivers against software that others wrote. README.md beside this file says more.
#
#   tests/vm/all.sh --sandbox-and-can     # what .ci/run runs of it: the unit's sandbox, and the bus of a kernel
set -euo pipefail
cd "$(dirname "$(realpath "$0")")/../.."
python=${PYTHON:-.venv/bin/python}
share=${XDG_CACHE_HOME:-$HOME/.cache}/otolith-vm/share

lacks=$(tests/vm/lacks.sh) || { echo "the system tests need what this computer lacks: $lacks" >&2; exit 2; }

begun=$SECONDS
PYTHON=$python tests/vm/image.sh >/dev/null
echo "guest ready after $((SECONDS - begun)) s"
begun=$SECONDS code=0
[ "${1:-}" = --sandbox-and-can ] || "$python" -m pytest -v -s tests/vm/test_modbus.py tests/vm/test_month.py || code=1
mkdir -p "$share"
rm -f "$share"/*.whl
"$python" -m pip --disable-pip-version-check wheel --quiet --no-deps --wheel-dir "$share" .

# The same disk through a first boot, a reboot, and a power cut.
work=$(mktemp -d)
trap 'rm -rf --one-file-system "$work"' EXIT
export SHARE=$share DISK=$work/disk
boot() { tests/vm/run.sh "$@" || code=1; }
if [ "${1:-}" = --sandbox-and-can ]; then
  boot tests/vm/in_guest.sh tests/vm/test_can.py tests/vm/test_unit.py \
    tests/vm/test_life.py::test_nobody_else_reads_or_publishes tests/vm/test_life.py::test_the_sandbox_is_tight
  exit $code
fi
SECONDS_AT_MOST=1800 boot tests/vm/in_guest.sh tests/vm/test_can.py tests/vm/test_unit.py tests/vm/test_hall.py \
  tests/vm/test_network.py tests/vm/test_life.py tests/vm/test_troubles.py tests/vm/test_boots.py::test_before_a_reboot
boot tests/vm/in_guest.sh tests/vm/test_boots.py::test_after_a_reboot '&&' python -m tests.vm.cut_power
boot tests/vm/in_guest.sh tests/vm/test_boots.py::test_after_a_power_cut
echo "system tests took $((SECONDS - begun)) s"
exit $code
