"""What every step of a placement says of itself: whether it was refused, and by which figures."""

from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

Reason = TypeVar("Reason", bound=str)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Outcome(Generic[Reason]):
    """Accepted where `reason` is None.

    Attributes:
        reason: gate that refused it, or None; `message` says it for people.
        figures: what the decision rests on, JSON-able.
    """

    reason: Reason | None
    message: str
    figures: dict[str, Any] = field(default_factory=dict)

    @property
    def accepted(self) -> bool:
        return self.reason is None
