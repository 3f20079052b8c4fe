"""An airspeed sensor, and one of everything else that a package can add."""
