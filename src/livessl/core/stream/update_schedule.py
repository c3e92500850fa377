"""Decides how often updates of a continuing sound are located: one every `update_frames`, or fewer under overload."""

from __future__ import annotations

from livessl.core.stream.pending_event import PendingEvent
from livessl.core.stream.site_state import SiteState


class UpdateSchedule:
    """Decides which windows of an event are located, and counts those that are not.

    Parameters
    ----------
    state : SiteState
        Contains the interval between two windows, and the share of them that an overloaded server locates.
    newest_only : bool
        Whether only the newest window is located if several are due in one step.
    """

    def __init__(self, state: SiteState, *, newest_only: bool) -> None:
        self._state = state
        self._newest_only = newest_only
        self._postponed: int | None = None
        self.left_out = 0
        """Number of windows that were not located, because newer ones were due."""
        self.shed = 0
        """Number of windows that were not located, because the server was overloaded."""

    def due_now(self, event: PendingEvent) -> int | None:
        """Return the last frame index of the window to locate now; None for no window, or for one later in this step.

        Call it whenever an active frame index of the event has closed.
        """
        count, others = divmod(event.length, self._state.parameters.update_frames)
        if others:
            return None
        every = self._state.relief.update_every
        if every is None or count % every:
            self.shed += 1
            return None
        if not self._newest_only:
            return event.closed
        self.left_out += self._postponed is not None
        self._postponed = event.closed
        return None

    def due_in_step(self) -> int | None:
        """Return the last frame index of the newest window that was postponed to the end of this step, if one was."""
        due, self._postponed = self._postponed, None
        return due
