"""A report in words, for logs and for those who only look."""

from otolith.estimation.information import QUANTILE
from otolith.health.schema import ReportDocument, Status


def summary(document: ReportDocument) -> str:
    """A report in one line."""
    parts = [f"window {document.window.index} {document.window.quality.verdict}"]
    for name, parameter in document.parameters.items():
        if parameter.value is None or parameter.sd is None:
            parts.append(f"{name} unknown ({parameter.reason})")
        else:
            held = "" if parameter.status is Status.ESTIMATED else f" ({parameter.status}: {parameter.reason})"
            parts.append(f"{name} {parameter.value:.5g} {parameter.unit} ± {QUANTILE * parameter.sd:.2g}{held}")
    parts += [f"{finding.severity}: {finding.text}" for finding in document.findings]
    if document.driver is not None:
        parts += [] if document.driver.up else [f"no connection: {document.driver.reason}"]
        parts += document.driver.warnings[:1]
        more = len(document.driver.warnings) - 1
        parts += [f"and {more} more like that"] if more > 0 else []
    return ", ".join(parts)
