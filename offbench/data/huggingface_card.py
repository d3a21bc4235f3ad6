"""`card --huggingface`: a recorded dataset's card for the Hugging Face Hub, README.md with a YAML header."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

from offbench.common.files import output_file, read_errors, read_text, write_bytes
from offbench.common.scores import normalize
from offbench.common.tables import markdown, plain
from offbench.data import minari_store
from offbench.data.show import Summary, format_value, show, space

SIZES = {1_000: "n<1K", 10_000: "1K<n<10K", 100_000: "10K<n<100K", 1_000_000: "100K<n<1M", 10_000_000: "1M<n<10M"}
MAX_SIZE_CATEGORY = "10M<n<100M"


def huggingface_card(dataset_id: str, out: str | Path | None = None) -> Path:
    """Write a dataset's card for the Hugging Face Hub; the license that an existing card states is kept.

    Args:
        dataset_id: a local Minari dataset.
        out: the file; default README.md in the dataset's own folder, so that an upload takes it along.

    Returns:
        The file.

    Raises:
        OffbenchError: no such dataset, it cannot be read, or the file cannot be written.
    """
    summary = show(dataset_id)
    folder = minari_store.path_of(dataset_id)
    target = output_file(folder / "README.md" if out is None else out)
    write_bytes(target, ("\n".join([*_header(summary, _license(target)), "", *_text(summary)]) + "\n").encode())
    return target


def _license(card: Path) -> list[str]:
    """Return the lines of an existing card's YAML that state its license."""
    if not card.exists():
        return []
    with read_errors(str(card), "is not readable text", "delete it"):
        header = read_text(card).partition("\n---")[0]
    return [line for line in header.splitlines() if line.startswith("license")]


def _header(summary: Summary, license_lines: list[str]) -> Iterator[str]:
    """Return the YAML that the Hub reads. It states no license of its own: the uploader chooses one."""
    steps = int(summary.lengths.sum())
    yield "---"
    yield f"pretty_name: {json.dumps(summary.dataset_id)}"
    yield from license_lines
    yield "task_categories: [reinforcement-learning]"
    yield "tags: [reinforcement-learning, offline-rl, minari, gymnasium]"
    size = next((name for most, name in SIZES.items() if steps < most), MAX_SIZE_CATEGORY)
    yield f'size_categories: ["{size}"]'
    yield "viewer: false"  # the Hub cannot show HDF5
    yield "---"


def _text(summary: Summary) -> Iterator[str]:
    meta, provenance, dataset_id = summary.metadata, minari_store.read_provenance(summary.metadata), summary.dataset_id
    yield f"# {plain(dataset_id)}"
    yield from ("", plain(str(meta.get("description") or "A Minari dataset.")), "")
    yield from ("## Use", "", "Replace USER by the account of this page:", "", "```sh")
    if "/" in dataset_id:
        yield f"MINARI_REMOTE=hf://USER minari download {dataset_id}"
    else:  # Minari finds no dataset without a namespace on the Hub
        where = f'"${{MINARI_DATASETS_PATH:-$HOME/.minari/datasets}}/{dataset_id}"'
        yield f"hf download USER/{dataset_id} --repo-type dataset --local-dir {where}"
    yield from (f"offbench verify {dataset_id}", f"offbench train td3_bc --dataset {dataset_id}", "```")
    yield from ("", "## Content", "")
    yield from _table(_content(summary))
    for number, part in enumerate(provenance.parts or (), 1):
        yield from ("", f"## Part {number}", "")
        yield from _table({key.replace("_", " "): format_value(value) for key, value in part.items()})
    yield from ("", "## Provenance", "")
    origin = {name: getattr(provenance, name) for name in ("env", "level", "seed", "recipe_sha256", "content_sha256")}
    origin["imported from"] = provenance.imported.get("file")
    origin |= provenance.versions
    recorded = {name.replace("_", " "): format_value(value) for name, value in origin.items() if value is not None}
    yield from _table(recorded) if recorded else ["Not recorded by offbench."]


def _content(summary: Summary) -> dict[str, str]:
    meta, returns, lengths = summary.metadata, summary.returns, summary.lengths
    mean = float(returns.mean())
    spread = f"std {returns.std():.1f}, {returns.min():.1f} to {returns.max():.1f}"
    facts = {
        "environment": json.loads(meta.get("env_spec") or "{}").get("id", "none"),
        "observations": space(meta, "observation_space"),
        "actions": space(meta, "action_space"),
        "transitions": f"{int(lengths.sum()):,}",
        "episodes": f"{len(returns):,}, {100 * summary.terminated:.1f}% terminated",
        "episode length": f"mean {lengths.mean():.1f}, {lengths.min()} to {lengths.max()}",
        "return of an episode": f"mean {mean:.1f}, {spread}",
    }
    if references := minari_store.references(meta):
        low, high = references
        facts["reference returns"] = f"{low:.1f} (score 0), {high:.1f} (score 100)"
        facts["normalized score of the data"] = f"{normalize(mean, low, high):z.1f}"
    if meta.get("algorithm_name"):
        facts["behaviour policy"] = str(meta["algorithm_name"])
    return facts


def _table(facts: dict[str, str]) -> list[str]:
    return markdown(["", ""], [[plain(name), plain(value)] for name, value in facts.items()])
