#!/bin/bash
# Prints what the system tests need and this computer lacks, and fails if there is anything.
set -euo pipefail
lacks=()
command -v linux.uml >/dev/null || lacks+=(user-mode-linux)
command -v mmdebstrap >/dev/null || lacks+=(mmdebstrap)
command -v mkfs.ext4 >/dev/null || lacks+=(e2fsprogs)
command -v gcc >/dev/null || lacks+=(gcc libc6-dev)
[ -e /usr/include/modbus/modbus.h ] || lacks+=(libmodbus-dev)
[ ${#lacks[@]} = 0 ] || lacks=("apt install ${lacks[*]}")
[ "$(id -u)" = 0 ] || lacks=("root, as it makes a guest${lacks:+; ${lacks[0]}}")
echo "${lacks[*]}"
[ ${#lacks[@]} = 0 ]
