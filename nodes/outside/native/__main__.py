"""Prints the folder of `visnav_link.hpp` and `client.py`.

``c++ -I"$(python -m nodes.outside.native)" …``
"""

from pathlib import Path

print(Path(__file__).parent)
