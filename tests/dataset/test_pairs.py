import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nss_ros.config import PairConfig
from nss_ros.dataset.complexity import geometric_complexity
from nss_ros.dataset.overlap import Cloud, pair_overlap
from nss_ros.dataset.pairs import PairTable, measure_pairs, read_pairs, write_pairs
from nss_ros.dataset.ply import write_ply
from nss_ros.errors import FormatError, InputError
from nss_ros.fragment import Fragment, FragmentId
from nss_ros.geometry import exponential, inverse, relative, transform_points

CONFIG = PairConfig()


def same(first, second):
    """Whether two tables hold the same rows, to the last bit."""
    return first.pairs == second.pairs and all(
        np.array_equal(getattr(first, name), getattr(second, name), equal_nan=name != "selected")
        for name in PairTable.__slots__[2:]
    )


@pytest.fixture(scope="module")
def site():
    """Two areas, two stages, 30 spots along a corridor with boxes of which some go away."""
    rng = np.random.default_rng(0)
    fragments, poses = [], {}
    for area in ("1", "2"):
        walls = rng.uniform((0, -1.5, 0), (40, 1.5, 2.8), (9000, 3))
        walls[:3000, 1], walls[3000:6000, 1], walls[6000:, 2] = -1.5, 1.5, 0
        clutter = rng.uniform((0, -1.4, 0), (40, 1.4, 1.5), (3000, 3))
        for stage in (1, 2):
            surface = np.concatenate((walls, clutter[::stage]))
            for spot in range(1, 16 if area == "1" else 4):
                position = (*rng.uniform((2, -1), (38, 1)), 1.6)
                pose = exponential([*position, 0.01, -0.01, rng.uniform(-3, 3)])
                near = surface[np.linalg.norm(surface - position, axis=1) < 4.5]
                points = transform_points(inverse(pose), near + rng.normal(0, 0.01, near.shape))
                id_ = FragmentId(area, stage, spot)
                fragments.append(Fragment(id_, points.astype(np.float32)))
                poses[id_] = pose
    return fragments, poses


@pytest.fixture(scope="module")
def table(site):
    return measure_pairs(*site, CONFIG, workers=1)


def test_every_pair_that_overlaps_is_there_with_its_figures(site, table):
    fragments, poses = site
    clouds = {fragment.id: Cloud(fragment.points) for fragment in fragments}
    rows = {(pair.source, pair.target): i for i, pair in enumerate(table.pairs)}
    ids = sorted(clouds)
    missing = 0
    for i, source in enumerate(ids):
        for target in ids[i + 1 :]:
            if source.area != target.area:
                assert (source, target) not in rows
                continue
            figures = pair_overlap(
                clouds[source], clouds[target], relative(poses[source], poses[target])
            )
            most = max(figures.overlap_ratio, figures.reverse_overlap_ratio)
            if most < CONFIG.least_overlap:
                assert (source, target) not in rows
                missing += 1
                continue
            row = rows.pop((source, target))
            assert table.overlap_ratio[row] == pytest.approx(figures.overlap_ratio, abs=1e-12)
            assert table.reverse_overlap_ratio[row] == pytest.approx(
                figures.reverse_overlap_ratio, abs=1e-12
            )
            assert table.temporal_change[row] == pytest.approx(
                figures.temporal_change, abs=1e-12, nan_ok=True
            )
    assert not rows
    assert missing > 20
    assert len(table) > 50


def test_complexity_is_that_of_each_fragment(site, table):
    points = {fragment.id: fragment.points for fragment in site[0]}
    for row in range(0, len(table), 20):
        for id_, value in (
            (table.source[row], table.source_complexity[row]),
            (table.target[row], table.target_complexity[row]),
        ):
            assert value == pytest.approx(geometric_complexity(points[id_]), abs=1e-12)
    np.testing.assert_allclose(
        table.complexity, (table.source_complexity + table.target_complexity) / 2
    )


def test_rows_are_in_canonical_order_and_nothing_is_selected(table):
    assert table.pairs == sorted(table.pairs)
    assert not table.selected.any()
    assert table.same_stage.any()
    assert not table.same_stage.all()


def test_neither_order_nor_workers_nor_files_matter(site, table, tmp_path):
    fragments, poses = site
    assert same(measure_pairs(fragments[::-1], poses, CONFIG, workers=2), table)
    files = {}
    for fragment in fragments:
        files[fragment.id] = tmp_path / f"{fragment.id}.ply"
        write_ply(files[fragment.id], dict(zip("xyz", fragment.points.T, strict=True)))
    assert same(measure_pairs(files, poses, CONFIG, workers=1), table)


def test_a_common_motion_of_the_map_changes_nothing(site, table):
    fragments, poses = site
    move = exponential([100, -50, 3, 0.1, 0.2, 1.0])
    moved = measure_pairs(
        fragments, {id_: move @ pose for id_, pose in poses.items()}, CONFIG, workers=1
    )
    assert moved.pairs == table.pairs
    np.testing.assert_allclose(moved.overlap_ratio, table.overlap_ratio, atol=1e-12)
    np.testing.assert_allclose(moved.temporal_change, table.temporal_change, atol=1e-12)


def test_progress_is_told(site):
    told = []
    table = measure_pairs(*site, CONFIG, 1, report=lambda *progress: told.append(progress))
    fragments = [progress[1:] for progress in told if progress[0] == "fragments"]
    assert fragments == [(i + 1, 36) for i in range(36)]
    pairs = [progress[1:] for progress in told if progress[0] == "pairs"]
    assert pairs[-1][0] == pairs[-1][1] >= len(table)
    assert pairs == sorted(pairs)


def test_an_empty_fragment_overlaps_nothing(site, table):
    fragments, poses = site
    empty = Fragment(FragmentId("1", 3, 1), np.zeros((0, 3), dtype=np.float32))
    poses = poses | {empty.id: poses[fragments[0].id]}
    assert same(measure_pairs([*fragments, empty], poses, CONFIG, workers=1), table)


def test_far_fragments_give_an_empty_table():
    points = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    ids = [FragmentId("1", 1, spot) for spot in (1, 2)]
    poses = {id_: exponential([100.0 * id_.spot, 0, 0, 0, 0, 0]) for id_ in ids}
    assert len(measure_pairs([Fragment(id_, points) for id_ in ids], poses, CONFIG, 1)) == 0


def test_what_cannot_be_measured_is_said(site, tmp_path):
    fragments, poses = site
    with pytest.raises(InputError, match="Bldg1_Stage1_Spot1 was given twice"):
        measure_pairs([*fragments, fragments[0]], poses, CONFIG, 1)
    with pytest.raises(InputError, match="Bldg1_Stage1_Spot1 has no pose"):
        measure_pairs(fragments, {}, CONFIG, 1)
    with pytest.raises(InputError, match="pose of Bldg1_Stage1_Spot1 is not a rigid transform"):
        measure_pairs(fragments, poses | {fragments[0].id: np.ones((4, 4))}, CONFIG, 1)
    for lonely in (fragments[:1], [fragments[0], fragments[-1]], []):
        with pytest.raises(InputError, match=f"{len(lonely)} fragments were given, and no area"):
            measure_pairs(lonely, poses, CONFIG, 1)
    broken = Fragment(fragments[0].id, np.full((4, 3), np.nan, dtype=np.float32))
    with pytest.raises(InputError, match=r"Bldg1_Stage1_Spot1 cannot be measured: .* not finite"):
        measure_pairs([broken, *fragments[1:]], poses, CONFIG, 1)
    files = {fragment.id: tmp_path / "none.ply" for fragment in fragments}
    with pytest.raises(FormatError, match=r"Cannot read point cloud .*none.ply"):
        measure_pairs(files, poses, CONFIG, 2)


numbers = st.floats(0, 1)
maybe = numbers | st.just(float("nan"))
ids = st.builds(FragmentId, st.sampled_from(["1", "B-2.x"]), st.integers(1, 9), st.integers(0, 99))


@given(
    st.lists(
        st.tuples(ids, ids, numbers, numbers, maybe, maybe, maybe).filter(lambda r: r[0] != r[1]),
        unique_by=lambda row: frozenset(row[:2]),
        max_size=6,
    ),
    st.integers(0, 63),
)
def test_a_table_is_read_back_exactly(make_table, tmp_path_factory, rows, bits):
    path = tmp_path_factory.mktemp("pairs") / "pairs.csv"
    pairs = make_table(rows).select(np.array([bits >> i & 1 for i in range(len(rows))]))
    write_pairs(path, pairs)
    again = read_pairs(path)
    assert same(again, pairs)
    assert again.selected.dtype == bool


HEADER = (
    "source,target,overlap_ratio,reverse_overlap_ratio,temporal_change,source_complexity,"
    "target_complexity,selected\n"
)
ROW = "Bldg1_Stage1_Spot1,Bldg1_Stage1_Spot2,0.5,0.25,nan,0.05,0.06,1\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "header lacks 'source'"),
        (b"\xff\xfe\x00", "not UTF-8"),
        ("a,b\n1,2\n", "header lacks 'source'"),
        (HEADER.replace("selected", "chosen"), "header lacks 'selected'"),
        (HEADER + ROW[:40], r"Line 2 of .*pairs.csv has 3 values instead of 8"),
        (HEADER + ROW + "\n", "Line 3 of .* has 1 values"),
        (HEADER + ROW[:-2], "'selected' in line 2 of .* must be 0 or 1, not ''"),
        (HEADER + ROW.replace("Bldg1_Stage1_Spot2", "scan"), "An id in line 2 .* 'scan'"),
        (HEADER + ROW.replace("0.25", "half"), "'reverse_overlap_ratio' in line 2 .* 'half'"),
        (HEADER + ROW.replace("0.25", "1.25"), "must be a number from 0 to 1, not '1.25'"),
        (HEADER + ROW.replace("0.5,", "nan,"), "must be a number from 0 to 1, not 'nan'"),
        (HEADER + ROW.replace("0.05", "inf"), "must be a number from 0 to 1, not 'inf'"),
        (HEADER + ROW + ROW, "Bldg1_Stage1_Spot1 -> Bldg1_Stage1_Spot2 occurs twice"),
        (HEADER + ROW.replace("Spot2", "Spot1"), "is of one fragment"),
    ],
)
def test_a_damaged_table_is_refused(tmp_path, text, words):
    path = tmp_path / "pairs.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(FormatError, match=words) as caught:
        read_pairs(path)
    assert str(path) in str(caught.value)


def test_a_missing_table_is_said(tmp_path):
    with pytest.raises(FormatError, match="Cannot read the pairs"):
        read_pairs(tmp_path / "none.csv")


def test_columns_may_come_in_any_order_and_with_others(tmp_path):
    path = tmp_path / "pairs.csv"
    words = [line.strip().split(",") for line in (HEADER, ROW)]
    path.write_text("\r\n".join(",".join([*line[::-1], "note"]) for line in words) + "\r\n")
    (pair,) = read_pairs(path).pairs
    assert str(pair) == "Bldg1_Stage1_Spot1 -> Bldg1_Stage1_Spot2"


def test_columns_must_be_of_one_length(table):
    with pytest.raises(InputError, match="differ in length"):
        table.select(np.zeros(3, dtype=bool))
