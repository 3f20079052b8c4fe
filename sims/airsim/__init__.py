"""AirSim's protocol, both ways: a server for its scripts, and a client of its simulators.

Both speak msgpack-rpc with AirSim's methods and structures: `wire` and `structures` are common.
"""
