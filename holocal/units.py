"""Units at the edges: SI inside, degrees, millimetres and nanometres in files and reports."""

from __future__ import annotations

from math import pi

DEGREE = pi / 180.0
MM = 1e-3
UM = 1e-6
NM = 1e-9
