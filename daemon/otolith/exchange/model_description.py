"""What an FMU says of itself: ``modelDescription.xml`` of FMI 2.0 and 3.0, and ``buildDescription.xml`` of FMI 3.0.

The library writes the XML, so any text of a twin or of a machine file may be in it.
"""

import re
from dataclasses import dataclass
from enum import StrEnum
from xml.etree import ElementTree as ET  # it only writes here

from otolith.exchange.fmi_variables import STARTS, FmuVariable, FmuVariables, Kind
from otolith_drivers.outside_text import visible
from otolith_drivers.units import base_exponents, to_base

NO_CHARACTER = re.compile("[\ufffe\uffff]")  # No document of XML 1.0 may have them
LOG_CATEGORY = "logStatusError"  # as in fmi/fmi2.c and fmi/fmi3.c
TRUE, FALSE = "true", "false"


class Version(StrEnum):
    """A version of the Functional Mock-up Interface."""

    TWO = "2"
    THREE = "3"

    @property
    def source(self) -> str:
        """The source file that an importer compiles; it includes the others."""
        return f"fmi{self.value}.c"


@dataclass(frozen=True, slots=True)
class Description:
    """What both versions say of an FMU."""

    title: str
    notes: tuple[str, ...]  # Of which machine and of which time it is
    identifier: str  # A name that C accepts: that of the binary
    token: str  # Of these equations and values
    tool: str  # That wrote it
    period: float  # Between two samples, s
    longest_step: float  # Of the integrator in co-simulation, s
    variables: FmuVariables

    def model(self, version: Version) -> str:
        """Return the text of ``modelDescription.xml``."""
        return _text(self._version_2() if version is Version.TWO else self._version_3())

    def build(self) -> str:
        """Return the text of ``sources/buildDescription.xml``, which FMI 3.0 asks for."""
        root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
        configuration = ET.SubElement(root, "BuildConfiguration", modelIdentifier=self.identifier)
        files = ET.SubElement(configuration, "SourceFileSet", language="C99")
        ET.SubElement(files, "SourceFile", name=Version.THREE.source)
        return _text(root)

    def _version_2(self) -> ET.Element:
        root = self._root(
            "2.0", {"guid": self.token, "numberOfEventIndicators": str(self.variables.count(Kind.INDICATOR))}
        )
        own = {"modelIdentifier": self.identifier, "canNotUseMemoryManagementFunctions": TRUE}
        own |= {"canGetAndSetFMUstate": TRUE, "canSerializeFMUstate": TRUE}
        interpolates = {"canHandleVariableCommunicationStepSize": TRUE, "canInterpolateInputs": TRUE}
        for kind, more in (("ModelExchange", {}), ("CoSimulation", interpolates)):
            element = ET.SubElement(root, kind, own | more)
            ET.SubElement(ET.SubElement(element, "SourceFiles"), "File", name=Version.TWO.source)
        self._units(root)
        ET.SubElement(ET.SubElement(root, "LogCategories"), "Category", name=LOG_CATEGORY)
        self._experiment(root)
        listed = ET.SubElement(root, "ModelVariables")
        for reference, row in enumerate(self.variables.rows):
            if row.kind is Kind.TIME:
                continue  # optional in this version: so the index of each variable is its value reference
            common = self._common(reference, row)
            real: dict[str, str] = {
                key: common.pop(key) for key in ("unit", "start", "nominal", "derivative") if key in common
            }
            ET.SubElement(ET.SubElement(listed, "ScalarVariable", common), "Real", real)
        structure = ET.SubElement(root, "ModelStructure")
        for name, kind in (("Outputs", Kind.OUTPUT), ("Derivatives", Kind.RATE)):
            group = ET.SubElement(structure, name)
            for reference, row in self._of(kind):
                known = " ".join(str(other) for other in self.variables.dependencies(row) if other)
                ET.SubElement(group, "Unknown", index=str(reference), dependencies=known)
        initial = ET.SubElement(structure, "InitialUnknowns")
        for reference, _ in self._of(Kind.RATE, Kind.OUTPUT):
            ET.SubElement(initial, "Unknown", index=str(reference))
        return root

    def _version_3(self) -> ET.Element:
        root = self._root("3.0", {"instantiationToken": self.token})
        own = {"modelIdentifier": self.identifier, "canGetAndSetFMUState": TRUE, "canSerializeFMUState": TRUE}
        ET.SubElement(root, "ModelExchange", own)
        steps = {"canHandleVariableCommunicationStepSize": TRUE, "providesIntermediateUpdate": TRUE}
        steps["fixedInternalStepSize"] = repr(self.longest_step)
        ET.SubElement(root, "CoSimulation", own | steps)
        self._units(root)
        ET.SubElement(ET.SubElement(root, "LogCategories"), "Category", name=LOG_CATEGORY)
        self._experiment(root)
        listed = ET.SubElement(root, "ModelVariables")
        for reference, row in enumerate(self.variables.rows):
            common = self._common(reference, row)
            if row.kind is Kind.INPUT and not row.is_held:
                common["intermediateUpdate"] = TRUE
            ET.SubElement(listed, "Float64", common)
        structure = ET.SubElement(root, "ModelStructure")
        for name, kind in (("Output", Kind.OUTPUT), ("ContinuousStateDerivative", Kind.RATE)):
            for reference, row in self._of(kind):
                known = " ".join(map(str, self.variables.dependencies(row)))
                ET.SubElement(structure, name, valueReference=str(reference), dependencies=known)
        for reference, _ in self._of(Kind.RATE, Kind.OUTPUT):
            ET.SubElement(structure, "InitialUnknown", valueReference=str(reference))
        for reference, _ in self._of(Kind.INDICATOR):
            ET.SubElement(structure, "EventIndicator", valueReference=str(reference))
        return root

    def _root(self, version: str, more: dict[str, str]) -> ET.Element:
        texts = {"modelName": self.title, "description": "; ".join(self.notes), "generationTool": self.tool}
        shown = {key: _plain(text) for key, text in texts.items()}
        naming = {"fmiVersion": version, "variableNamingConvention": "structured"}
        return ET.Element("fmiModelDescription", naming | shown | more)

    def _units(self, root: ET.Element) -> None:
        definitions = ET.SubElement(root, "UnitDefinitions")
        for text in dict.fromkeys(row.unit for row in self.variables.rows if row.unit):
            element = ET.SubElement(definitions, "Unit", name=_plain(text))
            exponents, (factor, offset) = base_exponents(text), to_base(text)
            if all(value.is_integer() for value in exponents.values()):
                base = {symbol: str(int(value)) for symbol, value in exponents.items()}
                base |= {} if factor == 1.0 else {"factor": repr(factor)}
                base |= {} if offset == 0.0 else {"offset": repr(offset)}
                ET.SubElement(element, "BaseUnit", base)

    def _experiment(self, root: ET.Element) -> None:
        ET.SubElement(root, "DefaultExperiment", startTime="0.0", stepSize=repr(self.period))

    def _common(self, reference: int, row: FmuVariable) -> dict[str, str]:
        """Return the attributes of a variable; ``derivative`` is the value reference of its state."""
        causality, variability, initial = self._role(row)
        found = {"name": row.name, "valueReference": str(reference), "description": _plain(row.meaning)}
        found |= {"causality": causality, "variability": variability}
        found |= {"initial": initial} if initial else {}
        found |= {"unit": _plain(row.unit)} if row.unit else {}
        found |= {"start": repr(float(row.start))} if row.kind in STARTS else {}
        found |= {"nominal": repr(float(row.nominal))} if row.kind is Kind.STATE and row.nominal > 0.0 else {}
        if row.kind is Kind.RATE:
            found["derivative"] = str(reference - self.variables.first[Kind.RATE] + self.variables.first[Kind.STATE])
        return found

    @staticmethod
    def _role(row: FmuVariable) -> tuple[str, str, str]:
        """Return causality, variability and initial of a variable; empty if it may have none."""
        return {
            Kind.TIME: ("independent", "continuous", ""),
            Kind.STATE: ("local", "continuous", "exact"),
            Kind.INPUT: ("input", "discrete" if row.is_held else "continuous", ""),
            Kind.OUTPUT: ("output", "continuous", "calculated"),
            Kind.PARAMETER: ("parameter", "tunable", "exact"),
            Kind.CONSTANT: ("local", "constant", "exact"),
        }.get(row.kind, ("local", "continuous", "calculated"))

    def _of(self, *kinds: Kind) -> list[tuple[int, FmuVariable]]:
        """Return value references and variables of some kinds."""
        return [(reference, row) for reference, row in enumerate(self.variables.rows) if row.kind in kinds]


def _plain(text: str) -> str:
    """Return a text from outside as one line that a document of XML may have."""
    return NO_CHARACTER.sub("\ufffd", visible(text))


def _text(root: ET.Element) -> str:
    ET.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ET.tostring(root, encoding="unicode")}\n'
