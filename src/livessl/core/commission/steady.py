"""Decides when a finding appears and ends (hysteresis, debouncing), so that it does not flicker with single sounds."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from livessl.core.commission.finding import Finding, in_order

CONFIRMING_SOUNDS: Final = 2
"""Number of sounds, one after the other, after which a finding is published: a single one may have been an echo."""

MOST_CONFIRMING: Final = 6
"""Most confirming sounds that count, so that a finding ends soon after the set-up has been mended."""

MOST_FOR: Final = 4
MOST_AGAINST: Final = 3
"""Most sounds of one examination that count for and against a finding: they were examined together, and have one
answer. A finding that was published with many sounds thus needs two examinations to end."""

UNSURE: Final = 0.5
"""Confidence up to which a finding must come again before it is published, however many sounds it is of: the echo of a
single sound may cause a contradiction that nothing explains."""

_SIGNAL: Final = frozenset({"dead", "deaf", "duplicate", "level"})
"""Faults of a channel's signal, of which a channel has at most one."""

_OF_CHANNELS: Final = frozenset({"inverted", "clipping", "dc", "hum", "noisy", "crosstalk"})
"""Faults of channels that are found one by one."""


@dataclass(slots=True)
class _Question:
    """One question about the set-up, such as what is wrong with the signal of a channel, and its answers.

    `support` is the number of sounds for the published answer, less those against it; `rival_support` is that of the
    latest other answer.
    """

    published: tuple[Finding, ...] = ()
    support: int = 0
    rival: tuple[Finding, ...] = ()
    rival_support: int = 0

    def note(self, answer: tuple[Finding, ...], sounds: int) -> None:
        """Take in the answer after some more sounds."""
        against, sounds = min(sounds, MOST_AGAINST), min(sounds, MOST_FOR)
        if self.published and _identity(answer) == _identity(self.published):
            self.published, self.support = answer, min(self.support + sounds, MOST_CONFIRMING)
            self.rival, self.rival_support = (), 0
            return
        self.support -= against
        if self.support <= 0:
            self.published, self.support = (), 0
        is_new = _identity(answer) != _identity(self.rival)
        if is_new and all(finding.confidence <= UNSURE for finding in answer):
            sounds = 1  # the latest one alone may have caused it
        self.rival_support = sounds if is_new else self.rival_support + sounds
        self.rival = answer
        if answer and not self.published and self.rival_support >= CONFIRMING_SOUNDS:
            self.published, self.support = answer, min(self.rival_support, MOST_CONFIRMING)
            self.rival, self.rival_support = (), 0

    @property
    def is_open(self) -> bool:
        """True if something is published, or may soon be."""
        return bool(self.published or self.rival)

    @property
    def is_contested(self) -> bool:
        """True if the latest answer is another than the published one."""
        return self.rival_support > 0


class SteadyFindings:
    """Decides which findings are published while examinations follow each other, each with some more sounds.

    A finding is published after `CONFIRMING_SOUNDS` sounds, an unsure one after as many examinations. It ends after as
    many sounds without it as there were with it, at most `MOST_CONFIRMING`. What is wrong with the order of channels
    and the poses is one question: its answers exclude each other, and another one is published after the first has
    ended.
    """

    def __init__(self) -> None:
        self._questions: dict[Hashable, _Question] = {}

    @property
    def is_doubtful(self) -> bool:
        """True if the latest answer to a question is another than what is published: the next sounds decide."""
        return any(state.is_contested for state in self._questions.values())

    def note(self, findings: Iterable[Finding], sounds: int) -> tuple[Finding, ...]:
        """Take in the findings of an examination, and return what is published, errors first.

        Parameters
        ----------
        findings : iterable of Finding
        sounds : int
            Number of sounds since the previous examination.
        """
        answers: dict[Hashable, list[Finding]] = {}
        for finding in findings:
            answers.setdefault(_question(finding), []).append(finding)
        for question in answers:
            self._questions.setdefault(question, _Question())
        for question, state in self._questions.items():
            state.note(tuple(answers.get(question, ())), sounds)
        self._questions = {question: state for question, state in self._questions.items() if state.is_open}
        return tuple(in_order(finding for state in self._questions.values() for finding in state.published))


def _identity_of(finding: Finding) -> tuple[str, str | None, int | None]:
    """Return what makes two findings the same although their numbers differ."""
    return finding.fault, finding.array, finding.channel


def _identity(findings: Sequence[Finding]) -> frozenset[tuple[str, str | None, int | None]]:
    return frozenset(_identity_of(finding) for finding in findings)


def _question(finding: Finding) -> Hashable:
    if finding.fault in _SIGNAL:
        return finding.array, finding.channel
    return _identity_of(finding) if finding.fault in _OF_CHANNELS else "set-up"
