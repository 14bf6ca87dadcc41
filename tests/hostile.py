"""Text that files, devices and servers must not pass on: what each of its characters does where it is raw."""

from hypothesis import strategies as st

HOSTILE = (
    "drive\nExecStartPre=+/bin/sh -c id",  # a line of a unit, a journal, a table
    "drive\rExecStartPre=+/bin/sh -c id",
    "drive\r\n[Service]\r\n",
    "drive\u2028next\u2029next\x85next\x0bnext\x0cnext",  # other ends of a line, for some readers
    "\x1b[2J\x1b]0;title\x07\x9b31m",  # commands to a terminal
    "drive\u202eevird\u2066\u200f",  # another direction of writing
    "a\0b",
    "a\"b'c`d$(id)${HOME}%h%%\\",  # quotes, variables, specifiers, the end of an escape
    "<script>alert(1)</script>&amp;",
    '=cmd|" /C calc"!A1',  # a formula of a table
    "fe80::1%eth0\nExecStartPre=+/bin/sh",  # an IPv6 address may name an interface, which may be anything
    "../../../etc/passwd",
    "/dev/ttyUSB0 rw\nUser=root",
    "/dev/%h",
    "a/**/b?c#d*",  # of a key of Zenoh
    'name{label="x"} 1\n',  # of Prometheus
    "x" * (1 << 20),
)
"""Each is one attack on one kind of file or screen."""

hostile_text = st.one_of(
    st.sampled_from(HOSTILE),
    st.text(st.characters(exclude_categories=()), max_size=40),
    st.text("\n\r\t\0\x1b\x85\u2028\u202e\"'\\%$`[]=;#/: a1", max_size=20),
)
"""Any text, often one with controls and signs of a grammar."""
