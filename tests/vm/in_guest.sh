#!/bin/bash
# In the guest: installs the wheel as README.md says, takes over compiled kernels of earlier runs, and tests.
set -euo pipefail
pip --disable-pip-version-check install --quiet --no-index --no-deps /mnt/share/*.whl
mkdir -p ~/.cache
# An archive and not a shared folder: the kernels are only found again if their times agree to the nanosecond.
if [ -s /mnt/share/kernels.tar ]; then tar -C ~/.cache -xf /mnt/share/kernels.tar; fi
code=0
PYTHONDONTWRITEBYTECODE=1 python -m pytest -v -s -p no:cacheprovider -p no:hypothesispytest --durations=0 --durations-min=1 "$@" || code=$?
if [ -d ~/.cache/otolith/kernels ]; then
  tar -C ~/.cache --format=posix -cf /mnt/share/kernels.new otolith/kernels
  mv /mnt/share/kernels.new /mnt/share/kernels.tar
fi
exit "$code"
