"""Every constant of this room that is no law of physics, and what it was chosen on.

Rates stand with their variables (`variables/kinds.py`), knees with their losses (`losses.py`), for
rooms below have them. A module reads these as `tuning.NAME`, so that an ablation changes one place.
"""

from __future__ import annotations

import math

# How fields move: Adam (E10.1). Chosen on the plume, by its density error.
BETAS = (0.9, 0.99)
"""How much Adam's moments keep of themselves in a step; the second less than customary, since runs
are short."""
FLOOR = 0.3
"""Added to the size of a cell's derivative, as a part of the root mean square of all.

So noise moves cells of which pictures say little less far than others.
"""
STIFFNESS = 2 * (1 - BETAS[0]) * (1 + 2 * BETAS[0]) / (1 + BETAS[0])
"""The part of smoothing's stiffness that is added as well. Derived, not chosen: half of it
is where steps neither swell nor fade, in a field that smoothing alone moves."""
WARM_UP = 5
"""Iterations at a resolution over which rates rise to their value: Adam's first steps are all of
full size, and would throw away what a coarser grid has found. With 10 the plume is less close."""

# How numbers move: damped Gauss-Newton steps (E10.2). Chosen on the capture at half size, and seen
# on Fig. 10 and 14.
DAMPING = 1.0
"""How much of its own curvature each parameter is damped by: alone, it goes half of the way."""
LARGEST_STEP = 4.0
"""No number moves by more than so many times its rate."""
LEVEL_RATE = 0.05
"""The rate of a field's level, as a part of it."""
REFRESH = 16
"""Iterations after which a picture's curvature is renewed: sooner, early at a resolution. With 4
results are the same, and take longer."""
APART, CLOSE = 0.5, 1e-5
"""Parts of a default rate by which differences of pictures are taken, and the largest tolerance of
the light in them. Of smaller parts, such as a tenth, what solves leave undone is seen: a sun's
direction then takes twice as many steps."""
LEAST = 1e-4
"""Least curvature, as a part of the parameter's largest: what no picture shows stays."""
TURN, SHIFT = math.radians(1.0), 0.005
"""How far a calibration's direction of a camera may be off [rad], and its place, as a part of its
distance from the volume: what films from ordinary calibrations err by (E10.3)."""
TRUST = 0.5
"""Pixels by which a volume may be off that was made with such cameras: pictures count against the
calibration as if each image were known no better."""

# How long a run is, and how exact (`schedule`, `levels`).
PLANNED, MOST_ITERATIONS = 300, 1000
"""A run that ends by itself refines and slows down as one of so many iterations, or sooner; and
makes at most so many."""
WINDOW, FALL = 20, 0.01
"""Iterations over which the loss must fall by more than this part of itself, or it is at rest."""
FEWEST_CELLS, FEWEST_PIXELS = 8, 16
"""No side of a grid or image longer than these is coarsened below them."""
GRADIENT_ERROR = 0.01
"""The relative error that each of the two solves may make in the gradient."""
TEST_EVERY = 10
"""Test views are rendered every so many iterations, and at the last."""
