"""The report's view of a sweep: the best variant of each algorithm on each dataset."""

from __future__ import annotations

from collections import Counter

from offbench.analysis.results import Results
from offbench.common.scores import mean_std
from offbench.common.tables import Table
from offbench.reports.tables import EMPTY, mark_notes, row_name, score_cell


def best_table(results: Results) -> Table | None:
    """Return the best variant of each algorithm with several, a row per dataset; None if each has a single one.

    Only scores of evaluations at the same steps are ranked.
    """
    variants = Counter(method.algorithm for method in results.methods)
    algorithms = [name for name, count in variants.items() if count > 1]
    rows, shown = [], []
    for task in results.tasks:
        cells = []
        for algorithm in algorithms:
            entries = [entry for entry in results.on(task) if entry.method.algorithm == algorithm]
            if not entries or len({entry.window for entry in entries}) > 1 or entries[0].window is None:
                cells.append(EMPTY)
                continue
            best = max(entries, key=lambda entry: mean_std(entry.scores)[0])
            cells.append(score_cell(best, f"{best.method.label}, best of {len(entries)}"))
            shown.append(best)
        if any(cell is not EMPTY for cell in cells):
            rows.append([*row_name(results, task, scored=True), *cells])
    if not rows:
        return None
    notes = [
        "The variant with the highest mean score. It was selected by the score shown, so this number is "
        "optimistic, and more so with more variants. To report it, train the selected variant with new seeds in "
        "another --runs folder.",
        *mark_notes(shown),
    ]
    return Table("best", "Best variant of each algorithm", ["level", "environment", *algorithms], rows, notes, heads=2)
