"""What one wants to know of a run first."""

from __future__ import annotations

from nss_ros.benchmark.run import Run
from nss_ros.fragment import FragmentId


def facts(run: Run) -> list[tuple[str, str]]:
    """Names and values, in the order of reading; what is not known is left out."""
    log, metadata = run.log, run.log.metadata
    ids = _fragments(run)
    stages = sorted({id_.stage for id_ in ids})
    methods = sorted({answer.method for answer in log.relative_transforms.values()})
    answered = len(log.relative_transforms)
    failed = sum(not answer.ok for answer in log.relative_transforms.values())
    ends = [*run.timing.answers[-1:], *run.timing.fragments[-1:]]
    bags = [v for k, v in sorted(metadata.items()) if k.startswith("bag_") and k[4:].isdigit()]
    values = (
        ("Log", str(log.path)),
        ("Recorded", metadata.get("start_time", "").replace("T", " ").replace("Z", " UTC")),
        ("Bag", ", ".join(bags)),
        ("Registration", ", ".join(methods)),
        ("Multi-way", log.pose_graph.synchronizer if log.pose_graph else ""),
        ("Split", run.evaluation.split if run.evaluation else ""),
        ("Trained on", run.evaluation.training if run.evaluation else ""),
        (
            "Fragments",
            f"{len(ids):,} in {len(stages)} stage{'s' * (len(stages) != 1)}" if ids else "",
        ),
        ("Pairs", f"{len(log.pairs):,} asked for, {answered:,} answered, {failed:,} failed"),
        ("Duration", f"{max(ends):.0f} s" if ends else ""),
        ("Version", f"{metadata.get('nss_ros', '')} {metadata.get('git_revision', '')}".strip()),
    )
    return [(name, value) for name, value in values if value]


def _fragments(run: Run) -> set[FragmentId]:
    """All that are named."""
    graphs = [*run.log.ground_truth, *([run.log.pose_graph] if run.log.pose_graph else [])]
    return {*run.log.fragments, *(node.id for graph in graphs for node in graph.nodes)}
