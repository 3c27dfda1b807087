"""An error budget as JSON (the fields are listed in docs/result.md)."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxbundle.adjustment.error_budget import Budget


def budget_dict(budget: "Budget") -> dict[str, Any]:
    """σ, total, and effect and share of every cause for each result; angles in the unit of the
    network."""
    columns = budget.table()
    results: dict[str, dict[str, Any]] = {}
    for name, cause, _, effect, share in zip(*(c.tolist() for c in columns.values())):
        result = results.setdefault(name, {"held": {}})
        if cause == "measurements":
            result |= {"sigma": effect, "share": share}
        elif cause == "total":
            result["total"] = effect
        else:
            result["held"][cause] = {"effect": effect, "share": share}
    held_causes = {}
    for cause in budget.causes:
        unit = budget.angle_scale if cause.angle else 1.0
        sigma = None if cause.sigma is None else cause.sigma * unit
        held_causes[cause.name] = {"sigma": sigma, "errors": len(cause.errors)}
    return {"held": held_causes, "results": results}
