"""A live page: agents, teachers, planners and the reader drive the compiled simulator side by side, attacked or not.

The way of a decision: page → :mod:`~rapid.play.server` (loopback, token) → :mod:`~rapid.play.session` (one tab) →
:mod:`~rapid.play.ride` (one episode) → page. Who can be chosen stands in :mod:`~rapid.play.roster`.
"""

from rapid.play.roster import Roster
from rapid.play.server import first_moment, serve

__all__ = ["Roster", "first_moment", "serve"]
