"""The pre-flight: what must hold before a run's first measurement. Each check has number, limit, verdict, remedy.

=============  ==========================================================================================
checks         one line of it, and the refusal when one fails
expectations   what a rig is held against besides its own facts: lock, file, accepted calibration
without_light  P01 lock, P02 disk, P03 identity, P04 output, P05 read-back, P06 dark frames, P14 age
with_light     P07 bits and full scale, P08 linearity, P09 clipping, P12 drift, on one random pattern
panel          P10 the panel moves the light, P11 the first frame after a change is the new picture
order          all of these in turn; those with light only when the others passed
=============  ==========================================================================================

P13, whether image and picture can be brought together, is left to the procedures, which alone know what they show.
The frames are 2 without light and 12 or so of two patterns, so that a simulated 4K panel is computed only three times.
"""

from __future__ import annotations

from holocal.loop.preflight.checks import Check, refuse_failed
from holocal.loop.preflight.expectations import Expectations
from holocal.loop.preflight.order import preflight

__all__ = ["Check", "Expectations", "preflight", "refuse_failed"]
