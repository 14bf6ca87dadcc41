from otolith.notebook import Twin as Twin

__version__: str
