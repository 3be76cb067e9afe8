"""Result of a search for plans."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from falsework.search.plans.alternatives import Alternatives
from falsework.search.plans.plan import Plan
from falsework.search.problem.result import Outcome, Result, SearchResult
from falsework.utils.display.notebook import Displayed


@dataclass(frozen=True, eq=False, repr=False)
class Planning(Result[Plan], Displayed):
    """Result of `find_plans`."""

    result: SearchResult
    """Outcome of the search and, if it found nothing, its progress."""
    plans: tuple[Plan, ...]
    """Plans, the one found first first."""
    alternatives: Alternatives
    """How much the plans differ; its routes are those of `plans`."""
    fallen: Plan | None = None
    """Without a plan whose replay succeeds: the one whose replay gets farthest, with the step at which it fails."""
    deadline_passed: bool = False
    """Whether the deadline ended the search; `result` and `plans` are the best that it had by then."""
    unreserved: str = ""

    @property
    def value(self) -> Plan | None:
        """The first plan."""
        return self.plans[0] if self.plans else None

    @property
    def outcome(self) -> Outcome:
        """Outcome of the search."""
        return self.result.outcome

    @property
    def bound(self) -> float | None:
        """Margin that the weakest step of no plan can exceed, where `maximise_margin` found one."""
        margins = None if self.value is None else self.value.margins
        return None if margins is None else margins.bound

    @property
    def statistics(self) -> dict[str, Any]:
        """Work of the search: `seconds`, `verdicts`, and the numbers of `SearchCounters`."""
        counters = asdict(self.result.counters)
        return {"seconds": self.result.seconds, "verdicts": counters.pop("asked"), **counters}

    @property
    def reason(self) -> str:
        """What limited a search without a plan; a proof that there is none needs no reason."""
        return "" if self.found else "; ".join(dict.fromkeys(filter(None, (self.result.limit, *self.result.notes))))

    @property
    def accepted(self) -> bool:
        """Whether there is one that stands under changed settings, if it has a reserve, and in the judge if asked."""
        keeps = [plan.claim.reserve == 1.0 or plan.replay is None or plan.replay.varied for plan in self.plans]
        judged = [plan.replay.judgement for plan in self.plans if plan.replay is not None]
        return self.found and all(keeps) and all(judgement is None or judgement.stands for judgement in judged)
