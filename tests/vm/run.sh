#!/bin/bash
# Runs a command as root in a booted Debian 12 guest (User Mode Linux: no KVM, nothing of the host but one folder).
#
#   tests/vm/run.sh COMMAND...        # like tests/vm/run.sh systemctl --failed
#
# The repository lies at /mnt/source, read-only, and is where COMMAND begins; $SHARE of the host at /mnt/share.
# What the guest writes to its disk is kept in the file $DISK, if that is set, for the next boot.
# Exit code: COMMAND's own; 124 not finished within $SECONDS_AT_MOST; 125 the guest failed.
set -euo pipefail
here=$(dirname "$(realpath "$0")")
limit=${SECONDS_AT_MOST:-900} memory=${MEGABYTES:-2048}
[ $# -gt 0 ] || { sed -n '2,/^set/{/^set/d;s/^# \{0,1\}//p}' "$0" >&2; exit 2; }

image=$("$here/image.sh")
work=$(mktemp -d)
share=$(realpath "${SHARE:-$work}")
guest=
finish() {
  if [ -n "$guest" ]; then kill -KILL -- "-$guest" 2>/dev/null || true; wait "$guest" 2>/dev/null || true; fi
  rm -rf --one-file-system "$work"
}
trap finish EXIT
trap 'exit 130' INT
trap 'exit 143' TERM HUP
settings=()
if grep -qw amx_tile /proc/cpuinfo; then
  gcc -O2 -Wall -Wextra -Werror -shared -fPIC -o "$work/whole_registers.so" "$here/whole_registers.c"
  settings+=("LD_PRELOAD=$work/whole_registers.so")
fi
# The guest's memory is a file: in /dev/shm, unless that is as small as containers have it.
[ "$(df --output=avail --block-size=M /dev/shm | tr -dc '0-9\n' | tail -1)" -ge "$memory" ] || settings+=("TMPDIR=$work")
rm -f "$share/rc" "$share/source"
ln -s "$(realpath "$here/../..")" "$share/source"
printf '%s ' "$@" >"$share/command"

# A session of its own, so that all of the guest ends with it. Its first terminal is our standard output.
begun=$SECONDS
# The machine in the guest sends in real time: on a busy computer the guest goes first. The niceness of a session, in
# which Linux groups processes, is that of its autogroup.
setsid nice -n -10 env "${settings[@]}" linux.uml "mem=${memory}M" "ubd0=${DISK:-$work/disk},$image" root=/dev/ubda rw \
  con=null con0=null,fd:3 con1=null,fd:1 ssl=null console=tty0 "uml_dir=$work" "otolith.share=$share" \
  quiet systemd.show_status=0 </dev/null 3>"$work/console" 2>&3 &
guest=$!
{ sleep 0.5; echo -10 >"/proc/$guest/autogroup"; } 2>/dev/null || true
while kill -0 "$guest" 2>/dev/null && [ $((SECONDS - begun)) -lt "$limit" ]; do sleep 0.2; done
if [ -s "$share/rc" ]; then exit "$(cat "$share/rc")"; fi
tail -n 40 "$work/console" >&2
if kill -0 "$guest" 2>/dev/null; then echo "the guest was not finished after $limit s" >&2; exit 124; fi
echo "the guest ended without a result" >&2
exit 125
