"""Every constant of this room that is no law of physics, and what it was chosen on.

Sizes of changes stand with their variables (`variables/kinds.py`), knees with their losses
(`losses.py`), for rooms below have them. A module reads these as `tuning.NAME`, so that an ablation
changes one place.
"""

from __future__ import annotations

import math

# How the search goes on (E10.1).
PAIRS = 6
"""Moves and changes of the derivative that stand for the second derivative, at most."""
SUFFICIENT = 1e-4
"""The least part of what the derivative promises that a step must bring (Armijo)."""
SHORTEST = 1e-3
"""A step is not shortened below this part of itself: then the metric is at fault."""
PROBES = 1
"""Random pictures by which the metric of fields is taken; neighbors share what they tell."""
FLOOR, POWER = 0.01, 0.5
"""The least entry of that metric, as a part of the root mean square of all: what no picture shows
does not move far. And its power: what is seen well moves further than its curvature says, so that
crusts do not grow at once. Powers of 1 are as good on solids and worse on clouds and flames."""
CYCLES, HELD = 3, 1e3
"""Cycles of multigrid by which the metric's inverse is taken, and how much more strongly than by
its neighbors an entry is held that does not move."""
GAINS, REST = 3, 0.004
"""A level ends where the last few steps could still gain less than this part of the loss."""

MODEL_ERROR, ELASTICITY = 0.01, 0.3
"""The part of its value by which a perfect image errs, and the power of the prior's weight with
which the loss of images falls at least, or else it is not the prior that keeps it."""

LIGHT = 0.5
"""A prior that weighs less than this part of the loss does not keep noise out of a volume."""
DENSER, BETTER = 4.0, 0.9
"""How much denser a trial begins, and the part of the last stage's loss that makes it better."""

# The metric of numbers (E10.2).
APART, CLOSE = 0.5, 1e-5
"""Parts of a kind's change by which differences of pictures are taken, and the largest tolerance
of the light in them. Of smaller parts, such as a tenth, what solves leave undone is seen: a sun's
direction then takes twice as many steps."""
LEAST, DAMPING = 1e-4, 0.1
"""Least curvature, as a part of the parameter's largest: what no picture shows stays. And the part
of their own curvature by which numbers move less (Levenberg 1944, doi:10.1090/qam/10666): pictures
bend, and combinations that they hardly show would go too far."""
TURN, SHIFT = math.radians(1.0), 0.005
"""How far a calibration's direction of a camera may be off [rad], and its place, as a part of its
distance from the volume: what films from ordinary calibrations err by (E10.3)."""
TRUST = 0.5
"""Pixels by which a volume may be off that was made with such cameras: pictures count against the
calibration as if each image were known no better."""

# How long a run is, and how exact (`schedule`, `setup`).
MOST_ITERATIONS = 300
"""A run that ends by itself makes at most so many."""
FEWEST_CELLS, FEWEST_PIXELS = 16, 16
"""No side of a grid or image is coarsened below these: a grid of 9 x 6 x 8 cells spread fog that
views from above did not take away."""
GRADIENT_ERROR = 0.01
"""The relative error that each of the two solves may make in the gradient."""
TEST_EVERY = 10
"""Test views are rendered every so many iterations, and at the last."""
