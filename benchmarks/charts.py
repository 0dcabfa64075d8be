"""The look that charts share, and the kinds that several suites draw. Without matplotlib nothing is drawn."""

from importlib.util import find_spec
from pathlib import Path

import numpy as np

OURS, OTHER, GREY = "#20638c", "#c2703d", "#8a8f94"
COLOURS = (OURS, OTHER, "#5a8f4e", "#8c5a9e", "#b8a02c", "#3f9a94", GREY, "#b04a5a")


def plt():
    """matplotlib's pyplot in the common look, None where it isn't installed."""
    if find_spec("matplotlib") is None:
        print("matplotlib is not installed: no chart")
        return None
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as pyplot

    look = {"font.size": 9, "axes.titlesize": 9, "axes.spines.top": False, "axes.spines.right": False}
    pyplot.rcParams.update(look | {"svg.hashsalt": "material palette", "svg.fonttype": "none", "figure.dpi": 110})
    return pyplot


def save(figure, path: Path) -> None:
    """path.svg and path.png, the same bytes for the same figure."""
    if figure.get_layout_engine() is None:
        figure.tight_layout()
    figure.savefig(path.with_suffix(".svg"), metadata={"Date": None})
    figure.savefig(path.with_suffix(".png"), dpi=110, metadata={"Software": None})
    print(f"chart: {path.with_suffix('.png').name}")


def bars(panels: dict[str, dict[str, list[float]]], path: Path, ours: str = "ours") -> None:
    """Per panel a bar per row: median, with a line between the quartiles; rows named from `ours` on in one colour."""
    pyplot = plt()
    if pyplot is None:
        return
    rows = list(dict.fromkeys(row for panel in panels.values() for row in panel))
    across = min(4, len(panels))
    down = -(-len(panels) // across)
    figure, axes = pyplot.subplots(down, across, figsize=(3.1 * across, down * (0.7 + 0.26 * len(rows))), sharey=True)
    for axis in np.ravel(axes)[len(panels) :]:
        axis.axis("off")
    for axis, (title, panel) in zip(np.ravel(axes), panels.items(), strict=False):
        for i, row in enumerate(rows):
            if panel.get(row):
                low, median, high = np.quantile(panel[row], (0.25, 0.5, 0.75))
                axis.barh(i, median, color=OURS if row.startswith(ours) else GREY, height=0.66)
                axis.plot([low, high], [i, i], color="#222222", linewidth=1.1)
        axis.set_title(title)
        axis.set_yticks(range(len(rows)), rows)
    np.ravel(axes)[0].invert_yaxis()
    save(figure, path)
    pyplot.close(figure)
