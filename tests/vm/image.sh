#!/bin/bash
# Builds the guest of the system tests, once: Debian 12 with systemd, can-utils and a venv of our dependencies and pytest.
# Prints where the image lies. It is made again when a dependency, the kernel or this script changes.
set -euo pipefail
umask 022
here=$(dirname "$(realpath "$0")") root=$(realpath "$here/../..")
python=${PYTHON:-$root/.venv/bin/python}
cache=${XDG_CACHE_HOME:-$HOME/.cache}/otolith-vm
packages=systemd,systemd-sysv,dbus,udev,kmod,iproute2,procps,can-utils,python3,python3-venv
size=2500M # sparse

kernel=$(linux.uml --version)
requirements=$("$python" - "$root/pyproject.toml" <<'PYTHON'
import sys, tomllib
with open(sys.argv[1], "rb") as file:
    project = tomllib.load(file)["project"]
extras = project["optional-dependencies"]
tools = [text for text in extras["dev"] if text.startswith(("hypothesis", "psutil", "pytest>"))]
print("\n".join([*project["dependencies"], *extras["mqtt"], *extras["opcua"], *tools]))
PYTHON
)
key=$(cat "$here/image.sh" "$here"/guest/* "$root/constraints.txt" <(echo "$requirements $kernel") | sha256sum)
image=$cache/guest-${key:0:12}.img
mkdir -p "$cache"
exec 9>"$cache/lock"
flock 9
if [ -s "$image" ]; then echo "$image"; exit; fi

[ "$(id -u)" = 0 ] || { echo "building the guest needs root: try it with sudo" >&2; exit 2; }
echo "building the guest, which takes a few minutes" >&2
work=$(mktemp -d "$cache/build.XXXXXX")
trap 'rm -rf --one-file-system "$work"' EXIT
guest=$work/root

# The host fetches the wheels, so that its own settings of pip hold; the guest's Python installs them.
echo "$requirements" >"$work/requirements"
"$python" -m pip --disable-pip-version-check download --quiet --dest "$work/wheels" --requirement "$work/requirements" \
  --constraint "$root/constraints.txt" --only-binary :all: --implementation cp --python-version 3.11 >&2

mmdebstrap --quiet --mode=root --variant=minbase --dpkgopt=force-unsafe-io --include="$packages" bookworm "$guest" >&2
mkdir -p "$guest/usr/lib/modules" "$guest/mnt/share" "$guest/mnt/source"
cp -a "/usr/lib/uml/modules/$kernel" "$guest/usr/lib/modules/"
chroot "$guest" depmod "$kernel"

mv "$work/wheels" "$work/requirements" "$guest/tmp/"
cp "$root/constraints.txt" "$guest/tmp/"
chroot "$guest" /usr/bin/env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/root PIP_DISABLE_PIP_VERSION_CHECK=1 sh -ec '
  python3 -m venv /opt/otolith
  /opt/otolith/bin/pip install --quiet --no-cache-dir --no-index --find-links /tmp/wheels \
    --constraint /tmp/constraints.txt --requirement /tmp/requirements
  rm -r /tmp/wheels /tmp/requirements /tmp/constraints.txt' >&2

echo otolith-guest >"$guest/etc/hostname"
echo "127.0.0.1 localhost otolith-guest" >"$guest/etc/hosts"
: >"$guest/etc/fstab" >"$guest/etc/machine-id"
install -m 755 "$here/guest/agent" "$guest/usr/local/sbin/otolith-agent"
install -m 644 "$here/guest/otolith-agent.service" "$guest/etc/systemd/system/"
chroot "$guest" systemctl --quiet enable otolith-agent.service
# A guest that lives for minutes has no use for these, and every fork costs it milliseconds.
chroot "$guest" systemctl --quiet mask apt-daily.timer apt-daily-upgrade.timer dpkg-db-backup.timer fstrim.timer \
  e2scrub_all.timer e2scrub_reap.service getty@tty1.service systemd-logind.service systemd-update-utmp.service

mkfs.ext4 -q -F -E lazy_itable_init=1 -d "$guest" "$work/image" "$size" >&2
find "$cache" -maxdepth 1 -name 'guest-*.img' -delete
mv "$work/image" "$image"
echo "$image"
