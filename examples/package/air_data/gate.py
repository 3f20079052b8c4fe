"""A world: a meadow with a gate to fly through."""

import mujoco

MODEL = """
<mujoco model="gate">
  <worldbody>
    <light pos="0 0 20" dir="0.3 0.2 -1" directional="true"/>
    <geom name="meadow" type="plane" size="40 40 0.1" rgba="0.3 0.5 0.2 1"/>
    <geom name="post_west" type="box" pos="6 2 1.5" size="0.1 0.1 1.5" rgba="0.8 0.2 0.1 1"/>
    <geom name="post_east" type="box" pos="6 -2 1.5" size="0.1 0.1 1.5" rgba="0.8 0.2 0.1 1"/>
  </worldbody>
</mujoco>
"""


def gate(seed: int, bare: bool) -> mujoco.MjSpec:
    """Return the world; nothing in it depends on the seed, and there are no images to leave out."""
    del seed, bare
    return mujoco.MjSpec.from_string(MODEL)
