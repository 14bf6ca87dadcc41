"""How a reading of registers can fail: the device says no, nobody answers, or the line is broken."""

# Modbus Application Protocol V1.1b3, section 7.
EXCEPTIONS = {
    1: "illegal function",
    2: "illegal data address",
    3: "illegal data value",
    4: "server device failure",
    5: "acknowledge, it takes longer",
    6: "server device busy",
    8: "memory parity error",
    10: "gateway path unavailable",
    11: "gateway target device failed to respond",
}
GATEWAY_CODES = (10, 11)


class Refused(Exception):  # noqa: N818 - what the device has done, said in the words of the field
    """The device answers that it does not want to.

    Example scenarios: registers that it does not have, more of them than it gives at once, busy.
    """

    def __init__(self, code: int) -> None:
        super().__init__(f"exception {code}, {EXCEPTIONS.get(code, 'unknown')}")
        self.code = code


class Silent(Exception):  # noqa: N818
    """No answer, or none to the question, in time; the line itself stands.

    Example scenarios: device switched off, wrong device number, wrong baud rate, a late answer to an earlier question.
    """


class Broken(Exception):  # noqa: N818
    """The line is gone.

    Example scenarios: connection refused or closed, host unreachable, serial adapter pulled out.
    """
