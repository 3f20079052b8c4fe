"""AirSim's protocol, both ways: a server for its scripts, and a client of its simulators."""
