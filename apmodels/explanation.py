"""Telling a person what was read from a model."""

from __future__ import annotations

import html
from typing import Any

from apmodels.structure import Arrow, Node


class Explanation:
    """The variables, the kind of every arrow, and what is integrated and what must be sampled, and why.

    ``print(model.explain())`` is text; in a notebook it is the drawing and the same tables.
    """

    def __init__(self, model: Any):
        self.model = model
        self.structure = model.structure

    def __str__(self) -> str:
        about = (type(self.model).__doc__ or "").strip().splitlines()
        # A class without a docstring gets its signature for one.
        about = [] if about and about[0].startswith(f"{type(self.model).__name__}(") else about
        lines = [repr(self.model), *(["  " + about[0]] if about else []), "", "variables"]
        lines += _table([_node_row(node) for node in self.structure.nodes.values()])
        lines += ["", "arrows"]
        lines += _table([_arrow_row(arrow) for arrow in self.structure.arrows])
        lines += ["", "plan"]
        lines += [f"  {line}" for line in self.plan()]
        return "\n".join(lines)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        from apmodels.drawing import draw

        return draw(self.model) + f"<pre>{html.escape(str(self))}</pre>"

    def plan(self) -> list[str]:
        """Return what is done with the hidden variables, a sentence each."""
        words = {
            "enumerated": "enumerated",
            "counted": "integrated by counting",
            "integrated": "integrated as Gaussians",
            "sampled": "sampled",
            "known": "known to the agent, by computing",
        }
        lines = []
        for plan, said in words.items():
            names = [node.name for node in self.structure.planned(plan)]
            if names:
                lines.append(f"{said}: {', '.join(names)}")
        lines.append(f"of interest: {', '.join(self.structure.interest)}")
        return lines


def _node_row(node: Node) -> list[str]:
    shape = "" if node.shape == () else "×".join(map(str, node.shape))
    values = f"{len(node.values)} values" if node.values is not None else shape
    return [node.name, node.role, node.family if node.role != "action" else "", values, node.plan, node.why]


def _arrow_row(arrow: Arrow) -> list[str]:
    parent = f"{arrow.parent} (a step ago)" if arrow.lag else arrow.parent
    return [f"{parent} → {arrow.child}", arrow.kind, arrow.why]


def _table(rows: list[list[str]]) -> list[str]:
    widths = [max((len(row[i]) for row in rows), default=0) for i in range(len(rows[0]))] if rows else []
    return ["  " + "  ".join(cell.ljust(n) for cell, n in zip(row, widths, strict=True)).rstrip() for row in rows]
