"""An error budget as JSON (the fields are listed in docs/result.md)."""


def budget_dict(budget) -> dict:
    """σ, total, and effect and share of every cause for each result; angles in the unit of the
    network."""
    columns, results = budget.table(), {}
    for name, cause, _, effect, share in zip(*(c.tolist() for c in columns.values())):
        of = results.setdefault(name, {"held": {}})
        if cause == "measurements":
            of |= {"sigma": effect, "share": share}
        elif cause == "total":
            of["total"] = effect
        else:
            of["held"][cause] = {"effect": effect, "share": share}
    held = {
        cause.name: {"sigma": _sigma(budget, cause), "errors": len(cause.errors)}
        for cause in budget.causes
    }
    return {"held": held, "results": results}


def _sigma(budget, cause) -> float | None:
    if cause.sigma is None:
        return None
    return cause.sigma * (budget.angle_scale if cause.angle else 1.0)
