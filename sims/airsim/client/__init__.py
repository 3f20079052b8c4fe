"""A node in the place of the simulator, which feeds a run from a server of AirSim's."""
