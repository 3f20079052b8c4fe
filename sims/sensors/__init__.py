"""Sensors other than cameras: pure models, and the suite for a vehicle's node.

A model makes measurements of the truth; it knows no clock and sends nothing, as `SensorSuite` does.
The modules are imported one by one: the table of sensors (`sims.sensors.sensor`), from which a
package's own sensor derives, is complete before the settings of a vehicle are made from it.
"""
