"""Small IFC models that the tests write themselves, and a storey of a real building."""

import logging

import ifcopenshell
import ifcopenshell.api.aggregate
import ifcopenshell.api.context
import ifcopenshell.api.geometry
import ifcopenshell.api.material
import ifcopenshell.api.owner
import ifcopenshell.api.project
import ifcopenshell.api.pset
import ifcopenshell.api.root
import ifcopenshell.api.sequence
import ifcopenshell.api.spatial
import ifcopenshell.api.unit
import ifcopenshell.guid
import numpy as np
import pytest
import yaml

from nss_ros.errors import ConfigError, FormatError, InputError
from nss_ros.simulation.element import Material
from nss_ros.simulation.ifc_plan import IfcArea
from nss_ros.simulation.ifc_site import build_ifc_site
from nss_ros.simulation.scene import Scene
from nss_ros.simulation.site_file import areas, site_file_of

STAGED = {
    "stages": [{"name": "shell"}, {"name": "studs"}, {"name": "closed"}],
    "rules": [
        {"ifc_class": ["IfcSlab"], "name": "upper*", "states": {1: "propped", 2: "built"}},
        {"name_regex": "[pP]artition", "states": {2: "studs", 3: "built"}},
        {"property": "Pset_WallCommon.FireRating", "value": "F*", "states": {3: "built"}},
        {"states": {1: "built"}},
    ],
}  # fmt: skip


class Model:
    """A one-storey house; lengths are given in metres and written in `unit`."""

    def __init__(self, schema="IFC4", millimetres=False, elevation=0.0, offset=(0.0, 0.0)):
        self.file = ifcopenshell.api.project.create_file(version=schema)
        self._factor = 1000.0 if millimetres else 1.0
        self._offset = offset
        self._elevation = elevation
        if schema == "IFC2X3":  # in which everything has an owner
            owner = ifcopenshell.api.owner
            person = owner.add_person(self.file)
            office = owner.add_organisation(self.file)
            owner.add_person_and_organisation(self.file, person=person, organisation=office)
            owner.add_application(self.file)
        root = ifcopenshell.api.root.create_entity
        project = root(self.file, "IfcProject", name="test")
        prefix = {"prefix": "MILLI"} if millimetres else {}
        length = ifcopenshell.api.unit.add_si_unit(self.file, unit_type="LENGTHUNIT", **prefix)
        ifcopenshell.api.unit.assign_unit(self.file, units=[length])
        model = ifcopenshell.api.context.add_context(self.file, context_type="Model")
        self._body = ifcopenshell.api.context.add_context(
            self.file, "Model", "Body", "MODEL_VIEW", parent=model
        )
        building = root(self.file, "IfcBuilding", name="house")
        self.storey = root(self.file, "IfcBuildingStorey", name="Level 1")
        self._place(self.storey, 0.0, 0.0, 0.0)
        ifcopenshell.api.aggregate.assign_object(
            self.file, products=[building], relating_object=project
        )
        ifcopenshell.api.aggregate.assign_object(
            self.file, products=[self.storey], relating_object=building
        )

    def _place(self, product, x, y, z):
        matrix = np.eye(4)
        matrix[:3, 3] = (x + self._offset[0], y + self._offset[1], z + self._elevation)
        matrix[:3, 3] *= self._factor
        ifcopenshell.api.geometry.edit_object_placement(
            self.file, product=product, matrix=matrix, is_si=False
        )

    def add(self, ifc_class, name, corner, size, valid=True, **properties):
        element = ifcopenshell.api.root.create_entity(self.file, ifc_class, name=name)
        self._place(element, *corner)
        points = [
            tuple(float(v) * s * self._factor for v, s in zip(index, size, strict=True))
            for index in np.ndindex(2, 2, 2)
        ]
        faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        make = self.file.create_entity
        corners = [make("IfcCartesianPoint", Coordinates=p if valid else (0.0, 0.0, 0.0))
                   for p in points]  # fmt: skip
        loops = [make("IfcPolyLoop", [corners[i] for i in face]) for face in faces]
        bounds = [make("IfcFace", [make("IfcFaceOuterBound", loop, True)]) for loop in loops]
        brep = make("IfcFacetedBrep", make("IfcClosedShell", bounds))
        shape = make("IfcShapeRepresentation", self._body, "Body", "Brep", [brep])
        ifcopenshell.api.geometry.assign_representation(self.file, element, shape)
        if ifc_class not in ("IfcSpace", "IfcOpeningElement"):
            ifcopenshell.api.spatial.assign_container(
                self.file, products=[element], relating_structure=self.storey
            )
        if properties:
            pset = ifcopenshell.api.pset.add_pset(
                self.file, product=element, name="Pset_WallCommon"
            )
            ifcopenshell.api.pset.edit_pset(self.file, pset=pset, properties=properties)
        return element

    def cut(self, wall, corner, size):
        """A hole through a wall."""
        self.file.create_entity(
            "IfcRelVoidsElement",
            GlobalId=ifcopenshell.guid.new(),
            RelatingBuildingElement=wall,
            RelatedOpeningElement=self.add("IfcOpeningElement", "hole", corner, size),
        )

    def house(self):
        self.add("IfcSlab", "floor", (0, 0, -0.2), (8, 6, 0.2))
        self.add("IfcSlab", "upper slab", (0, 0, 2.8), (8, 6, 0.2))
        for name, corner, size in [
            ("south", (0, 0, 0), (8, 0.2, 2.8)), ("north", (0, 5.8, 0), (8, 0.2, 2.8)),
            ("west", (0, 0.2, 0), (0.2, 5.6, 2.8)), ("east", (7.8, 0.2, 0), (0.2, 5.6, 2.8)),
        ]:  # fmt: skip
            self.add("IfcWall", name, corner, size, LoadBearing=True)
        self.add("IfcWall", "Partition 1", (4, 0.2, 0), (0.1, 4, 2.6), LoadBearing=False)
        self.add("IfcWall", "rated", (0.2, 4, 0), (2, 0.1, 2.6), FireRating="F90")
        self.add("IfcColumn", "HEA 200", (6, 3, 0), (0.2, 0.2, 2.8))
        self.add("IfcSpace", "room", (0.2, 0.2, 0), (7, 5, 2.6))
        return self

    def write(self, path):
        self.file.write(str(path))
        return path.name


@pytest.fixture
def build(tmp_path):
    def builder(*names, **settings):
        settings = {"files": list(names), "cache": str(tmp_path / "cache"), **settings}
        return build_ifc_site("A", IfcArea(**settings), tmp_path)

    return builder


def kinds(site, stage):
    return sorted(element.name for element in site.elements if stage in element.stages)


@pytest.mark.parametrize("schema", ["IFC2X3", "IFC4", "IFC4X3"])
def test_a_plan_stages_a_storey(tmp_path, build, schema):
    name = Model(schema).house().write(tmp_path / "house.ifc")
    site = build(name, **STAGED)
    assert site.stage_names == ("shell", "studs", "closed")
    shell = ["HEA 200", "east", "floor", "north", "south", "upper slab", "west"]
    assert kinds(site, 1) == sorted([*shell, "upper slab, props"])
    assert kinds(site, 2) == sorted([*shell, "Partition 1, studs", "Partition 1, track"])
    assert kinds(site, 3) == sorted([*shell, "Partition 1", "rated"])
    assert not any(element.kind == "IfcSpace" for element in site.elements)
    (column,) = [element for element in site.elements if element.name == "HEA 200"]
    assert column.material is Material.METAL
    assert site.source["storey"] == "Level 1"
    assert site.source["skipped"] == []


@pytest.mark.parametrize("schema", ["IFC2X_FINAL", "IFC2X2_FINAL"])
def test_a_file_of_an_older_schema_is_read_and_that_is_told(tmp_path, build, schema):
    path = tmp_path / "house.ifc"
    Model("IFC2X3").house().write(path)
    expected = build(path.name, **STAGED)
    text = path.read_text()
    assert "'IFC2X3'" in text
    path.write_text(text.replace("'IFC2X3'", f"'{schema}'"))
    site = build(path.name, **STAGED)
    assert site.source["skipped"] == [
        f"house.ifc is of the older schema {schema}; it is read as IFC2X3."
    ]
    for stage in (1, 2, 3):
        assert kinds(site, stage) == kinds(expected, stage)
    path.write_text(text.replace("'IFC2X3'", "'IFC9'"))
    with pytest.raises(FormatError, match=r"IFC9.* Export it anew as IFC2X3, IFC4 or IFC4X3"):
        build(path.name, **STAGED)


def test_each_storey_is_an_area_if_asked(tmp_path):
    model = Model("IFC2X3").house()
    ground = model.storey
    model.storey = ifcopenshell.api.root.create_entity(
        model.file, "IfcBuildingStorey", name="Level [2]"
    )
    model._elevation = 3.0
    model._place(model.storey, 0, 0, 0)
    ifcopenshell.api.aggregate.assign_object(
        model.file,
        products=[model.storey],
        relating_object=model.file.by_type("IfcBuilding")[0],
    )
    model.add("IfcWall", "north of 2", (0, 5.8, 0), (8, 0.2, 2.8))
    model.storey = ifcopenshell.api.root.create_entity(model.file, "IfcBuildingStorey", name="Roof")
    model._elevation = 6.0
    model._place(model.storey, 0, 0, 0)
    model.add("IfcSlab", "roof", (0, 0, 0), (8, 6, 0.2))
    path = str(tmp_path / model.write(tmp_path / "two [storeys].ifc"))
    site_file, folder = site_file_of([path], storeys="*")
    built = dict(areas(site_file, folder, 0))
    assert list(built) == ["1", "2"]
    one, two = built["1"](), built["2"]()
    assert one.source["storey"] == ground.Name == "Level 1"
    assert two.source["storey"] == "Level [2]"
    assert two.source["origin"][2] == pytest.approx(3.0)
    assert "north of 2" in kinds(two, 1)
    assert "north of 2" not in kinds(one, 1)
    assert one.source["clutter"] > 0
    site_file, folder = site_file_of([path])
    ((_, build),) = areas(site_file, folder, 0)
    usual, note = build().source["notes"]
    assert "no place in the usual order of works" in usual
    assert "1 IfcWall" in usual  # nothing says whether the wall 'rated' bears loads
    assert "Area 1 is the storey 'Level 1'" in note
    assert "'Level [2]' at 3 m" in note
    assert "--storeys '*'" in note
    site_file, _ = site_file_of([path], storeys="Level [[]*")
    assert list(site_file.areas) == ["1"]
    with pytest.raises(InputError, match="matches 'Cellar': the files have 'Level 1' at 0 m"):
        site_file_of([path], storeys="Cellar")
    with pytest.raises(InputError, match="--storeys is for IFC files"):
        site_file_of(["demo"], storeys="*")


def test_a_storey_is_where_its_elements_are(tmp_path, build):
    """Trade models of one storey each, which all say that it lies at 0, as real ones do."""
    for number, floor in enumerate((0.0, 2.9, 5.8)):
        model = Model("IFC2X3")
        model.storey.Name = f"S{number}"
        model.add("IfcSlab", f"slab {number}", (0, 0, floor - 0.2), (8, 6, 0.2))
        for y in (0, 2, 4, 5.8):
            model.add("IfcWall", f"wall {number}", (0, y, floor), (8, 0.2, 2.6))
        model.write(tmp_path / f"s{number}.ifc")
    site = build("s*.ifc", storey="S1")
    assert site.source["origin"][2] == pytest.approx(2.9)
    names = {element.name for element in site.elements}
    assert "wall 1" in names
    assert not {"wall 0", "wall 2"} & names
    paths = [str(path) for path in sorted(tmp_path.glob("s*.ifc"))]
    site_file, _ = site_file_of(paths, storeys="*")
    assert [entry.ifc.storey for entry in site_file.areas.values()] == ["S0", "S1", "S2"]


def test_the_blocks_of_a_wall_are_staged_as_the_wall(tmp_path, build):
    model = Model("IFC2X3").house()
    wall = ifcopenshell.api.root.create_entity(model.file, "IfcWall", name="of blocks")
    ifcopenshell.api.spatial.assign_container(
        model.file, products=[wall], relating_structure=model.storey
    )
    pset = ifcopenshell.api.pset.add_pset(model.file, product=wall, name="Pset_WallCommon")
    ifcopenshell.api.pset.edit_pset(model.file, pset=pset, properties={"LoadBearing": True})
    block = model.add("IfcBuildingElementPart", "", (2, 2, 0), (2, 0.2, 0.6))
    ifcopenshell.api.aggregate.assign_object(model.file, products=[block], relating_object=wall)
    rules = [
        {
            "ifc_class": ["IfcWall"],
            "property": "Pset_WallCommon.LoadBearing",
            "value": "True",
            "states": {2: "built"},
        },
        {"states": {1: "built"}},
    ]
    name = model.write(tmp_path / "house.ifc")
    site = build(name, stages=[{}, {}], rules=rules)
    (found,) = [each for each in site.elements if each.name == "of blocks"]
    assert found.kind == "IfcBuildingElementPart"
    assert found.stages == {2}


def test_units_elevation_and_large_offsets_do_not_matter(tmp_path, build):
    plain = build(Model().house().write(tmp_path / "plain.ifc"), **STAGED)
    far = Model(millimetres=True, elevation=6.0, offset=(155_000.0, 463_000.0)).house()
    moved = build(far.write(tmp_path / "far.ifc"), **STAGED)
    assert moved.floor_height == plain.floor_height == 0.0
    for one, other in zip(plain.elements, moved.elements, strict=True):
        assert (one.name, one.stages) == (other.name, other.stages)
        np.testing.assert_allclose(one.mesh.vertices, other.mesh.vertices, atol=1e-4)


def test_a_ray_sees_studs_then_a_wall(tmp_path, build):
    site = build(Model().house().write(tmp_path / "house.ifc"), **STAGED)
    eye = np.array([2.0, 2.0, 1.6])
    yaw = np.linspace(-0.4, 0.4, 200)
    rays = np.column_stack((np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)))
    hit = []
    for stage in (1, 2, 3):
        distances = Scene(site.stage_mesh(stage).mesh).cast(eye, rays).distances
        hit.append(float((distances < 3.0).mean()))
    assert hit[0] < 0.15  # the props under the upper slab
    assert hit[0] < hit[1] < 0.5
    assert hit[2] > 0.95


def test_doors_and_windows_of_a_stud_wall_stay_open(tmp_path, build):
    model = Model("IFC2X3")
    model.add("IfcSlab", "floor", (0, 0, -0.2), (8, 6, 0.2))
    wall = model.add("IfcWall", "Partition", (1, 3, 0), (6, 0.1, 2.6))
    model.cut(wall, (2.0, 2.9, 0), (0.9, 0.3, 2.1))  # a door
    model.cut(wall, (4.5, 2.9, 0.9), (1.2, 0.3, 1.1))  # a window
    plan = {
        "stages": [{}, {}, {}],
        "rules": [
            {"name": "Partition", "states": {1: "track", 2: "studs", 3: "one_side"}},
            {"states": {1: "built"}},
        ],
    }
    site = build(model.write(tmp_path / "door.ifc"), **plan)
    x = np.arange(1.0125, 7.0, 0.025)
    for stage in (1, 2, 3):
        scene = Scene(site.stage_mesh(stage).mesh)

        def solid(z, scene=scene):
            eyes = np.column_stack((x, np.full_like(x, 2.0), np.full_like(x, z)))
            toward = np.tile((0.0, 1.0, 0.0), (len(x), 1))
            return scene.cast(eyes, toward).distances < 1.5

        door = (x > 2.0) & (x < 2.9)
        window = (x > 4.5) & (x < 5.7)
        assert not solid(0.02)[door].any()
        assert solid(0.02)[~door].all()
        if stage >= 2:
            assert not solid(1.5)[door | window].any()
            assert solid(2.58).all()
            jambs = solid(1.5)[[np.argmin(abs(x - place)) for place in (1.98, 2.92, 4.48, 5.72)]]
            assert jambs.all()
            assert 0 < solid(1.5).mean() < 0.5 or stage == 3
            assert solid(2.3)[door].any()
            assert solid(0.5)[window].any()
        if stage == 3:
            assert solid(1.5)[~door & ~window].all()
            assert solid(2.3)[door].all()


def test_what_a_plan_does_not_do_is_told(tmp_path, build):
    model = Model().house()
    model.add("IfcRailing", "rail", (1, 1, 0), (2, 0.05, 1.0))
    name = model.write(tmp_path / "house.ifc")
    assert build(name, **STAGED).source["notes"] == []
    rules = [
        {"ifc_class": ["IfcWall", "IfcSlab", "IfcColumn"], "states": {1: "built"}},
        {"name": "Partition*", "states": {2: "built"}},
        {"file": "*.steel", "states": {1: "built"}},
        {"name": "rail", "by_schedule": True},
    ]
    stages = [{"date": "2026-01-01"}, {"date": "2026-02-01"}]
    shadowed, nothing, undated = build(name, stages=stages, rules=rules).source["notes"]
    assert "rule 2 {name: Partition*, states: {2: built}} does nothing" in shadowed
    assert "take all 1 elements" in shadowed
    assert "rule 3 {file: *.steel, states: {1: built}} matches no element" in nothing
    assert "1 elements of rules by schedule have no date" in undated
    (forgotten,) = build(name, stages=stages, rules=rules[:1]).source["notes"]
    assert "no rule matches 1 elements, which are left out at all stages: 1 IfcRailing" in forgotten
    model.add("IfcBuildingElementProxy", "box", (1, 2, 0), (1, 1, 1.0))
    (usual,) = build(model.write(tmp_path / "more.ifc")).source["notes"]
    assert "no place in the usual order of works" in usual
    assert "1 IfcBuildingElementProxy" in usual


def test_without_a_plan_the_usual_order_of_works_holds(tmp_path, build):
    model = Model().house()
    model.add("IfcFurniture", "desk", (5, 1, 0), (1.6, 0.8, 0.75))
    site = build(model.write(tmp_path / "house.ifc"))
    assert site.stage_names == ("shell", "rough", "finished")
    assert "Partition 1, studs" in kinds(site, 2)
    assert "Partition 1" not in kinds(site, 2)
    assert {"Partition 1", "desk"} <= set(kinds(site, 3))
    assert "desk" not in kinds(site, 2)


def test_dates_of_a_schedule_decide(tmp_path, build):
    model = Model().house()
    late = model.add("IfcWall", "late", (2, 2, 0), (1, 0.1, 2.0))
    name = model.write(tmp_path / "house.ifc")
    (tmp_path / "plan.csv").write_text(f"GlobalId,finish\n{late.GlobalId},2026-03-01\n")
    stages = [{"name": "a", "date": "2026-02-01"}, {"name": "b", "date": "2026-04-01"}]
    rules = [{"name": "late", "by_schedule": True}, {"states": {1: "built"}}]
    site = build(name, stages=stages, rules=rules, schedule="plan.csv")
    (element,) = [element for element in site.elements if element.name == "late"]
    assert element.stages == {2}
    (tmp_path / "plan.csv").write_text("GlobalId,finish\nx,soon\n")
    with pytest.raises(FormatError, match="Line 2"):
        build(name, stages=stages, rules=rules, schedule="plan.csv")


def test_a_broken_element_is_left_out_by_name(tmp_path, build, caplog):
    caplog.set_level(logging.CRITICAL)
    model = Model().house()
    bad = model.add("IfcBeam", "broken beam", (1, 1, 2), (1, 0.2, 0.2), valid=False)
    site = build(model.write(tmp_path / "house.ifc"), **STAGED)
    (sentence,) = site.source["skipped"]
    assert "house.ifc" in sentence
    assert "IfcBeam" in sentence
    assert bad.GlobalId in sentence
    assert "broken beam" in sentence
    assert len(kinds(site, 1)) == 8


def test_the_cache_gives_the_same_site(tmp_path, build):
    name = Model().house().write(tmp_path / "house.ifc")
    first = build(name, **STAGED)
    (kept,) = (tmp_path / "cache").iterdir()
    second = build(name, **STAGED)
    kept.write_bytes(b"damaged")
    third = build(name, **STAGED)
    for site in (second, third):
        for one, other in zip(first.elements, site.elements, strict=True):
            assert np.array_equal(one.mesh.vertices, other.mesh.vertices)
            assert np.array_equal(one.mesh.triangles, other.mesh.triangles)


def test_a_model_without_floor_gets_one(tmp_path, build):
    model = Model()
    model.add("IfcWall", "wall", (0, 0, 0), (6, 0.2, 2.5))
    name = model.write(tmp_path / "wall.ifc")
    site = build(name)
    assert "ground" in {element.kind for element in site.elements}
    bare = build(name, ground=False)
    assert "ground" not in {element.kind for element in bare.elements}


def test_other_storeys_are_left_out_and_what_goes_on_is_cut(tmp_path, build):
    model = Model().house()
    model.add("IfcWall", "wall above", (0, 0, 3.0), (8, 0.2, 2.8))
    model.add("IfcWall", "wall below", (0, 0, -3.0), (8, 0.2, 2.8))
    model.add("IfcColumn", "through", (2, 2, -3.0), (0.3, 0.3, 9.0))
    site = build(model.write(tmp_path / "house.ifc"), floor=0.0, ceiling=3.0, **STAGED)
    names = kinds(site, 1)
    assert {"through", "floor", "upper slab"} <= set(names)
    assert not {"wall above", "wall below"} & set(names)
    (column,) = [element for element in site.elements if element.name == "through"]
    assert column.mesh.vertices[:, 2].min() == pytest.approx(-0.6)
    assert column.mesh.vertices[:, 2].max() == pytest.approx(3.6)


def test_an_added_floor_lies_under_the_building_only_and_at_the_height_given(tmp_path, build):
    model = Model()
    model.add("IfcSlab", "filigree slab", (0, 0, -0.25), (4, 12, 0.06))
    for corner, size in [
        ((0, 0, 0), (12, 0.2, 2.6)), ((0, 0, 0), (0.2, 12, 2.6)), ((12, 0, 0), (0.2, 4, 2.6)),
        ((4, 4, 0), (8, 0.2, 2.6)), ((4, 4, 0), (0.2, 8, 2.6)), ((0, 12, 0), (4, 0.2, 2.6)),
    ]:  # fmt: skip
        model.add("IfcWall", "wall", corner, size)
    site = build(model.write(tmp_path / "angle.ifc"), floor=0.0, ceiling=3.0)
    scene = Scene(site.stage_mesh(1).mesh)
    down = np.array([(0.0, 0.0, -1.0)])
    # There is none in the angle, but a strip along the walls of the lowest storey.
    for place, distance in (((2, 2, 1), 1.0), ((13, 2, 1), 1.0), ((9, 9, 1), np.inf)):
        assert scene.cast(np.array(place), down).distances[0] == pytest.approx(distance)


def test_steel_is_metal_by_its_material(tmp_path, build):
    model = Model().house()
    beam = model.add("IfcBeam", "L12", (1, 1, 2.5), (3, 0.2, 0.2))
    steel = ifcopenshell.api.material.add_material(model.file, name="STEEL/S235JR")
    ifcopenshell.api.material.assign_material(model.file, products=[beam], material=steel)
    site = build(model.write(tmp_path / "house.ifc"), **STAGED)
    (found,) = [element for element in site.elements if element.name == "L12"]
    assert found.material is Material.METAL


def test_a_rule_may_say_what_a_sensor_meets(tmp_path, build):
    model = Model().house()
    model.add("IfcPlate", "RAAM 7", (1, 1, 1), (1, 0.05, 1.2))
    name = model.write(tmp_path / "house.ifc")
    panes = {"name": "raam *", "states": {2: "built"}, "material": "glass"}
    walls = {"name": "Partition 1", "states": {2: "studs", 3: "built"}, "material": "dark"}
    staged = STAGED | {"rules": [panes, walls, *STAGED["rules"]]}
    materials = {element.name: element.material for element in build(name, **staged).elements}
    assert materials["RAAM 7"] is Material.GLASS
    assert materials["Partition 1"] is Material.DARK
    assert materials["Partition 1, studs"] is Material.METAL
    plain = {element.name: element.material for element in build(name, **STAGED).elements}
    assert Material.GLASS not in plain.values()


@pytest.mark.parametrize("outcome", [True, False])
def test_tasks_in_the_file_decide(tmp_path, build, outcome):
    model = Model().house()
    late = model.add("IfcWall", "late", (2, 2, 0), (1, 0.1, 2.0))
    task = ifcopenshell.api.sequence.add_task(model.file, name="masonry")
    time = ifcopenshell.api.sequence.add_task_time(model.file, task=task)
    time.ScheduleFinish = "2026-03-01T17:00:00"
    if outcome:
        ifcopenshell.api.sequence.assign_product(
            model.file, relating_product=late, related_object=task
        )
    else:
        ifcopenshell.api.sequence.assign_process(
            model.file, relating_process=task, related_object=late
        )
    stages = [{"date": "2026-02-01"}, {"date": "2026-04-01"}]
    rules = [{"name": "late", "by_schedule": True}, {"states": {1: "built"}}]
    site = build(model.write(tmp_path / "house.ifc"), stages=stages, rules=rules)
    (element,) = [element for element in site.elements if element.name == "late"]
    assert element.stages == {2}


def test_a_model_without_storeys_begins_at_its_lowest_point(tmp_path, build):
    model = Model().house()
    ifcopenshell.api.root.remove_product(model.file, product=model.storey)
    site = build(model.write(tmp_path / "house.ifc"), **STAGED)
    assert {"floor", "north", "upper slab"} <= set(kinds(site, 1))
    assert site.source["origin"][2] == pytest.approx(0.0)


def test_a_model_without_anything_in_it_is_refused(tmp_path, build):
    with pytest.raises(InputError, match="has a shape to scan: give files of a building"):
        build(Model().write(tmp_path / "bare.ifc"))


def test_a_mistake_in_a_file_is_told(tmp_path, build):
    path = tmp_path / "house.ifc"
    Model().house().write(path)
    lines = path.read_text().splitlines()
    statements = [i for i, line in enumerate(lines) if line.startswith("#")]
    assert not build("house.ifc").source["skipped"]

    def spoil(statement):
        broken = [*lines]
        broken[statements[statement]] += " *//*"
        path.write_text("\n".join(broken))

    spoil(-4)
    (sentence,) = build("house.ifc").source["skipped"]
    assert sentence.startswith("house.ifc has a mistake, after which 3 statements are not read")
    spoil(3)
    left = len(statements) - 4
    with pytest.raises(InputError, match=rf"shape to scan \(house\.ifc .* after which {left:,} st"):
        build("house.ifc")


def test_what_cannot_be_built_is_refused(tmp_path, build):
    name = Model().house().write(tmp_path / "house.ifc")
    with pytest.raises(InputError, match=r"no IFC file .*none\.ifc"):
        build("none.ifc")
    with pytest.raises(InputError, match="no storey 'Roof', but 'Level 1'"):
        build(name, storey="Roof")
    with pytest.raises(InputError, match="no element between"):
        build(name, floor=40.0)
    with pytest.raises(InputError, match="no element at stage 1"):
        build(name, stages=[{}, {}], rules=[{"states": {2: "built"}}])
    (tmp_path / "text.ifc").write_text("nothing of the kind")
    with pytest.raises(FormatError, match=r"text\.ifc cannot be read"):
        build("text.ifc")
    (tmp_path / "plan.yaml").write_text(
        yaml.safe_dump({"areas": {"1": {"ifc": {"files": [name], "rules": [{}], "stages": [{}]}}}})
    )
    with pytest.raises(ConfigError, match="by_schedule"):
        site_file_of([str(tmp_path / "plan.yaml")])


def test_a_real_building(shared_data, tmp_path):
    """Two trades of the ground floor of Schependomlaan."""
    folder = shared_data / "schependomlaan"
    area = {
        "files": ["XELLA-Begane_grond.ifc", "YTONG-*.ifc", "GEELEN-Breedplaat_V1.ifc"],
        "floor": -0.1,
        "ceiling": 2.9,
        "cache": str(tmp_path),
        "stages": [{}, {}],
        "rules": [{"file": "YTONG-*", "states": {2: "built"}}, {"states": {1: "built"}}],
    }
    (tmp_path / "plan.yaml").write_text(yaml.safe_dump({"areas": {"1": {"ifc": area}}}))
    site_file, _ = site_file_of([str(tmp_path / "plan.yaml")])
    ((_, build),) = areas(site_file, folder, 0)
    site = build()
    first, second = (len(kinds(site, stage)) for stage in (1, 2))
    assert first > 100
    assert second > first
    assert 15 < site.extent.x1 - site.extent.x0 < 30
    extent = site.extent
    middle = np.array([(extent.x0 + extent.x1) / 2, (extent.y0 + extent.y1) / 2, 1.5])
    around = np.column_stack((np.cos(np.arange(360)), np.sin(np.arange(360)), np.zeros(360)))
    distances = Scene(site.stage_mesh(1).mesh).cast(middle, around).distances
    assert np.isfinite(distances).mean() > 0.8
