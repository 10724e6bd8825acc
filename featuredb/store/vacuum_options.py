"""How much of the past a vacuum keeps."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class VacuumOptions:
    """How much of the past to keep.

    Attributes:
        history_h: snapshots that were newest within this time stay readable. 30 days: long enough to notice
            that a merge was wrong and to roll it back. Images of contributed photos that were refused stay as
            long, for those who ask why.
        orphan_grace_h: child rows without a map stay this long, since a running commit may be about to name
            them. A day; commits give up after six hours. Take less only where nobody else writes.
        file_grace_h: files that no snapshot uses stay this long for readers that have opened them. A day.
    """

    history_h: float = 24.0 * 30
    orphan_grace_h: float = 24.0
    file_grace_h: float = 24.0
