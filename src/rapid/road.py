"""The road and its cars in metres and m/s, as highway-env has them: what more than one module needs.

This module imports nothing.
"""

LANE_WIDTH = 4.0
"""Metres. The middle of lane i is at y = 4 i."""
CAR_LENGTH, CAR_WIDTH = 5.0, 2.0
"""Metres."""
SIGHT = 200.0
"""Metres along the road within which cars are observed."""
RANGES = (SIGHT, LANE_WIDTH, 80.0)
"""What 1 means in a normalised feature: metres along, metres across for each lane, m/s (highway-env's own ranges)."""
START_SPEED = 25.0
"""m/s with which the ego begins an episode."""
