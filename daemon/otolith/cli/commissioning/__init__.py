"""The commands by which a machine is described and commissioned."""
