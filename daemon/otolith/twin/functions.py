"""Functions that SymPy lacks, or has with properties that a machine does not care for."""

import sympy


class sign(sympy.Function):  # type: ignore[misc]  # noqa: N801 - sympy has no types; printed as it is called
    """The sign, with the slope that it has beside its step: SymPy's own asks whether its argument is real."""

    def fdiff(self, argindex: int = 1) -> sympy.Expr:
        """Zero."""
        del argindex
        return sympy.Integer(0)


class absolute(sympy.Function):  # type: ignore[misc]  # noqa: N801 - as above
    """The absolute value of a real quantity."""

    def fdiff(self, argindex: int = 1) -> sympy.Expr:
        """The sign."""
        del argindex
        return sign(self.args[0])

    def _pretty(self, printer: object) -> object:
        return printer._print(sympy.Abs(self.args[0]))  # type: ignore[attr-defined]  # what sympy hands every printer

    def _latex(self, printer: object) -> str:
        found: str = printer._print(sympy.Abs(self.args[0]))  # type: ignore[attr-defined]  # as above
        return found


class component(sympy.Function):  # type: ignore[misc]  # noqa: N801 - as above
    """``component(family, x, a, b, c)``: a meta-model, which the kernel looks up by the family's number."""

    def fdiff(self, argindex: int = 1) -> sympy.Expr:
        """By anything but the family."""
        slope: sympy.Expr = SLOPES[argindex - 2](*self.args)
        return slope


class component_x(component):  # noqa: N801 - as above
    """Its derivative by the input."""


class component_a(component):  # noqa: N801 - as above
    """Its derivative by the amplitude."""


class component_b(component):  # noqa: N801 - as above
    """Its derivative by the inner number."""


class component_c(component):  # noqa: N801 - as above
    """Its derivative by the phase."""


SLOPES = (component_x, component_a, component_b, component_c)
