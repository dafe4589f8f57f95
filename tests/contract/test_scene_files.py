"""Files of points, layers, meshes and views: what is read, and what is refused with file, line or key, and number."""

from __future__ import annotations

import struct

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from holocal.errors import InputError
from holocal.records import scene_points
from holocal.records.maps import write_maps
from holocal.records.scene import read_scene
from holocal.records.scene_data import DepthImage
from holocal.records.scene_layers import read_layers
from holocal.records.scene_mesh import read_mesh
from holocal.records.scene_points import read_points
from holocal.records.scene_views import read_light_field

HEADER = "theta_x_deg,theta_y_deg,distance_m,intensity\n"


def refused(read, path, said):
    """The error that a file is refused with; it names the file, and says what to do or why."""
    with pytest.raises(InputError, match=said) as caught:
        read(path)
    assert path.name in str(caught.value)
    assert caught.value.fix or caught.value.why
    return caught.value


# -- points -----------------------------------------------------------------------------------------------------------


def test_points_are_read_in_any_order_of_columns_with_comments_spaces_and_infinity(tmp_path):
    text = "\ufeff# a bench target\n\n intensity, distance_m ,theta_y_deg,theta_x_deg # names\n1,inf,-3,10\n\n# more\n"
    text += " 2.5 , 0.25 , 4e0 , -59.9 # last\n   \n \t# end\n"
    (tmp_path / "p.csv").write_text(text, encoding="utf-8")
    points = read_points(tmp_path / "p.csv")
    np.testing.assert_allclose(points.angle_rad, np.radians([[10, -3], [-59.9, 4]]))
    np.testing.assert_array_equal(points.distance_m, [np.inf, 0.25])
    np.testing.assert_array_equal(points.intensity, [1, 2.5])


@settings(max_examples=30, deadline=None)
@given(
    rows=st.lists(
        st.tuples(
            st.floats(-59.9, 59.9),
            st.floats(-59.9, 59.9),
            st.floats(1e-3, exclude_min=True),
            st.floats(1e-6, 1e12),
        ),
        min_size=1,
        max_size=8,
    )
)
def test_every_number_comes_back_to_its_last_bit(tmp_path_factory, rows):
    path = tmp_path_factory.mktemp("points") / "p.csv"
    path.write_text(HEADER + "".join(",".join(map(repr, row)) + "\n" for row in rows))
    points = read_points(path)
    np.testing.assert_allclose(points.angle_rad, np.radians(np.array(rows)[:, :2]), rtol=1e-15)
    np.testing.assert_array_equal(points.distance_m, np.array(rows)[:, 2])
    np.testing.assert_array_equal(points.intensity, np.array(rows)[:, 3])


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ("0,0,1,1\n# so\n\n0,0,0,1\n0,0,-1,1\n", r"line 5: distance_m is 0; it must be above 0 m.*\(1 more"),
        ("0,0,nan,1\n", "line 2: distance_m is nan"),
        ("0,0,1,1\n60,0,1,1\n", "line 3: theta_x_deg is 60; it must be between -60 and 60"),
        ("0,-75,1,1\n", "line 2: theta_y_deg is -75"),
        ("nan,0,1,1\n", "line 2: theta_x_deg is nan"),
        ("0,0,1,-0.1\n", "line 2: intensity is -0.1"),
        ("0,0,1,inf\n", "line 2: intensity is inf"),
        ("0,0,1,nan\n", "line 2: intensity is nan"),
        ("0,0,1,1\n\n0,0,1\n", "line 4: 3 values; there are 4 columns"),
        ("0,0,1\n0,0,1\n", "line 2: 3 values"),
        ("0,0,1,1,\n", "line 2: 5 values"),
        ("0,0,1,1\n0,left,1,1\n", "line 3: 'left' is not a number"),
        ("0,,1,1\n", "line 2: '' is not a number"),
        ("0,1_0,1,1\n", "line 2: '1_0' is not a number"),
        ("0,0,1,0\n0,0,2,0\n", "every intensity is 0"),
        ("# nothing\n", "no points below its header, line 1"),
        ("", "no points"),
    ],
)
def test_a_line_that_cannot_be_is_refused_with_its_number(tmp_path, rows, said):
    (tmp_path / "p.csv").write_text(HEADER + rows)
    refused(read_points, tmp_path / "p.csv", said)


@pytest.mark.parametrize(
    ("header", "said"),
    [
        ("", "is empty"),
        ("# only words\n", "is empty"),
        ("theta_x_deg,theta_y_deg,distance_m\n0,0,1\n", "line 1: .*missing: intensity"),
        ("#\ntheta_x,theta_y_deg,distance_m,intensity\n", "line 2: .*unknown: 'theta_x' Did you mean theta_x_deg"),
        ("theta_x_deg,theta_y_deg,distance_m,intensity,colour\n", "unknown: 'colour'"),
        ("theta_x_deg,theta_y_deg,distance_m,intensity,intensity\n", "twice"),
        ("0,0,1,1\n", "unknown: '0'"),
    ],
)
def test_a_header_that_cannot_be_is_refused(tmp_path, header, said):
    (tmp_path / "p.csv").write_text(header)
    refused(read_points, tmp_path / "p.csv", said)


def test_a_points_file_that_is_absent_a_directory_or_no_text_is_refused(tmp_path):
    refused(read_points, tmp_path / "no.csv", "cannot be read: No such file")
    (tmp_path / "d.csv").mkdir()
    refused(read_points, tmp_path / "d.csv", "cannot be read")
    (tmp_path / "b.csv").write_bytes(HEADER.encode() + b"\xff\xfe\x00\n")
    refused(read_points, tmp_path / "b.csv", "not a text file")


def test_too_many_points_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(scene_points, "MOST_POINTS", 3)
    (tmp_path / "p.csv").write_text(HEADER + "0,0,1,1\n" * 3)
    assert len(read_points(tmp_path / "p.csv").intensity) == 3
    (tmp_path / "p.csv").write_text(HEADER + "0,0,1,1\n" * 4)
    refused(read_points, tmp_path / "p.csv", "more than 3 points")


# -- layers -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def images(tmp_path):
    """A directory with images of 4 x 3 pixels: ramp, black, half; and of 2 x 2: small."""
    (tmp_path / "sub").mkdir()
    ramp = np.arange(12, dtype=np.uint8).reshape(3, 4) * 20
    for name, pixels in {
        "sub/ramp.png": ramp,
        "black.png": ramp * 0,
        "half.png": np.full((3, 4), 51, np.uint8),
        "small.png": np.full((2, 2), 255, np.uint8),
    }.items():
        cv2.imwrite(str(tmp_path / name), pixels)
    write_maps(tmp_path / "bright.exr", {"Y": np.full((3, 4), 2.0)})
    return tmp_path


def listed(directory, text):
    path = directory / "scene.toml"
    path.write_text(text)
    return path


def test_layers_are_read_with_paths_relative_to_their_file(images):
    scene = read_layers(
        listed(
            images,
            'schema = 1\n[[layer]]\nimage = "sub/ramp.png"\ndepth_m = 0.5\nmask = "half.png"\nintensity = 3.0\n'
            '[[layer]]\nimage = "black.png"\ndepth_m = inf\n[[layer]]\nimage = "small.png"\ndepth_m = 2\n',
        )
    )
    first, second, third = scene.layers
    np.testing.assert_allclose(first.intensity, np.arange(12).reshape(3, 4) * 20 / 255 * 3, rtol=1e-6)
    np.testing.assert_allclose(first.mask, 0.2, rtol=1e-6)
    assert (first.depth_m, second.depth_m, third.depth_m) == (0.5, np.inf, 2.0)
    assert second.mask is None and not second.intensity.any() and third.intensity.shape == (2, 2)
    assert scene.occlusion is None


def test_srgb_is_undone_in_images_and_not_in_masks(images):
    path = listed(
        images, 'schema = 1\nocclusion = false\n[[layer]]\nimage = "half.png"\ndepth_m = 1\nmask = "half.png"\n'
    )
    scene = read_layers(path, srgb=True)
    assert scene.layers[0].intensity[0, 0] == pytest.approx(((0.2 + 0.055) / 1.055) ** 2.4, rel=1e-5)
    assert scene.layers[0].mask[0, 0] == pytest.approx(0.2) and scene.occlusion is False


LAYER = 'schema = 1\n[[layer]]\nimage = "sub/ramp.png"\ndepth_m = 1\n'


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("schema = 2\n", "schema is 2"),
        ("schema = true\n", "schema is True"),
        ("schema = 1\n", "here neither"),
        ("schema = \n", "not a TOML file: .*line 1"),
        (LAYER + "[rgbd]\n", "not both"),
        (LAYER + "dept_m = 2\n", "layer 1: unknown key dept_m. Did you mean depth_m"),
        ("occlude = true\n" + LAYER, "unknown key occlude. Did you mean occlusion"),
        (LAYER + "[[layer]]\ndepth_m = 1\n", "layer 2: image is missing"),
        (LAYER + '[[layer]]\nimage = "no.png"\ndepth_m = 1\n', "layer 2: image = 'no.png' is not a file"),
        (LAYER + '[[layer]]\nimage = "sub"\ndepth_m = 1\n', "layer 2: image = 'sub' is not a file"),
        (LAYER + '[[layer]]\nimage = "a\\u0000b"\ndepth_m = 1\n', "layer 2: image = .* is not a file"),
        ('schema = 1\n[[layer]]\nimage = "small.png"\ndepth_m = 0\n', "layer 1: depth_m = 0 is not greater than 0"),
        ('schema = 1\n[[layer]]\nimage = "small.png"\ndepth_m = nan\n', "layer 1: depth_m = nan"),
        ('schema = 1\n[[layer]]\nimage = "small.png"\ndepth_m = "near"\n', "layer 1: depth_m = 'near'"),
        (LAYER + "intensity = -1\n", "layer 1: intensity = -1 is not greater than 0"),
        (LAYER + 'mask = "small.png"\n', "layer 1: mask = 'small.png' has 2 x 2 pixels; 4 x 3 are needed"),
        (LAYER + 'mask = "bright.exr"\n', "layer 1: mask = 'bright.exr' has values up to 2"),
        ('schema = 1\n[[layer]]\nimage = "black.png"\ndepth_m = 1\n', "every layer is black"),
        (LAYER + 'mask = "black.png"\n', "every layer is black"),
        ("schema = 1\nlayer = 3\n", "layer = 3 cannot be"),
        ("schema = 1\nlayer = [1, 2]\n", "layer"),
    ],
)
def test_layers_that_cannot_be_are_refused_naming_layer_and_key(images, text, said):
    if not text.startswith("schema") and "schema" in text:  # a top key goes before the tables
        text = text.replace("schema = 1\n", "", 1)
        text = "schema = 1\n" + text
    refused(read_layers, listed(images, text), said)


def test_a_list_that_is_absent_no_text_or_enormous_is_refused(tmp_path):
    refused(read_layers, tmp_path / "no.toml", "cannot be read")
    (tmp_path / "b.toml").write_bytes(b"\xff\x00")
    refused(read_light_field, tmp_path / "b.toml", "not a text file")
    (tmp_path / "big.toml").write_bytes(b"#" * (4 * 2**20 + 1))
    refused(read_layers, tmp_path / "big.toml", "4194305 bytes")


def test_depths_in_a_png_are_linear_in_dioptres_between_far_and_near(images):
    text = 'schema = 1\n[rgbd]\nimage = "sub/ramp.png"\ndepth = "{}"\nnear_m = 0.25\nfar_m = {}\nlayers = 5\n'
    scene = read_layers(listed(images, text.format("sub/ramp.png", 2.0)))
    assert isinstance(scene, DepthImage) and scene.layers == 5
    np.testing.assert_allclose(1 / scene.depth_m, 0.5 + np.arange(12).reshape(3, 4) * 20 / 255 * 3.5, rtol=1e-6)
    scene = read_layers(listed(images, text.format("black.png", "inf")))
    assert np.all(np.isinf(scene.depth_m))


def test_depths_in_an_exr_are_metres_and_may_be_infinite(images):
    depth = np.linspace(0.1, 2, 12).reshape(3, 4)
    depth[0, 1] = np.inf
    write_maps(images / "d.exr", {"Z": depth, "id": np.ones((3, 4))})
    scene = read_layers(listed(images, 'schema = 1\n[rgbd]\nimage = "sub/ramp.png"\ndepth = "d.exr"\nlayers = 3\n'))
    np.testing.assert_allclose(scene.depth_m, depth, rtol=1e-6)


@pytest.mark.parametrize(
    ("depth", "keys", "said"),
    [
        ("half.png", "", "near_m and far_m are needed"),
        ("half.png", "near_m = 1.0\n", "near_m and far_m are needed"),
        ("half.png", "near_m = 1.0\nfar_m = 1.0\n", "near_m = 1 is not below far_m = 1"),
        ("half.png", "near_m = inf\nfar_m = inf\n", "near_m"),
        ("bright.exr", "near_m = 1.0\nfar_m = 2.0\n", "for depths in a PNG"),
        ("small.png", "near_m = 1.0\nfar_m = 2.0\n", "depth = 'small.png' has 2 x 2 pixels; 4 x 3"),
        ("bright.exr", "layers = 0\n", "layers = 0 is not at least 1"),
        ("bad.exr", "", "2 depths that are NaN or not above 0"),
        ("two.exr", "", "channels .*; depths are in its only channel, or in Z"),
        ("no.exr", "", "depth = 'no.exr' is not a file"),
        ("text.exr", "", "not an image"),
    ],
)
def test_depths_that_cannot_be_are_refused(images, depth, keys, said):
    values = np.ones((3, 4))
    write_maps(images / "two.exr", {"R": values, "G": values})
    values[1, 1], values[2, 2] = np.nan, -1
    write_maps(images / "bad.exr", {"Y": values})
    (images / "text.exr").write_text("hello")
    layers = "" if "layers" in keys else "layers = 4\n"
    path = listed(images, f'schema = 1\n[rgbd]\nimage = "half.png"\ndepth = "{depth}"\n{layers}{keys}')
    with pytest.raises(InputError, match=said):
        read_layers(path)


def test_occlusion_of_an_image_with_depths_is_refused(images):
    path = listed(
        images, 'schema = 1\nocclusion = true\n[rgbd]\nimage = "half.png"\ndepth = "bright.exr"\nlayers = 2\n'
    )
    refused(read_layers, path, "occlusion is for")


def test_a_black_image_is_refused_unless_it_is_part_of_a_scene(images):
    refused(read_scene, images / "black.png", "black everywhere")
    assert not read_scene(images / "black.png", allow_black=True).any()


# -- meshes -----------------------------------------------------------------------------------------------------------

VERTICES = "v 0 0 1\nv 1 0 1\nv 0 1 1\nv 1 1 2\n"


def corners(mesh):
    """The places of each face's corners, in an order that does not depend on where a face begins."""
    found = []
    for face in mesh.vertices_m[mesh.faces].tolist():
        first = face.index(min(face))
        found.append(tuple(map(tuple, face[first:] + face[:first])))
    return sorted(found)


TWO = sorted([((0, 0, 1), (1, 0, 1), (0, 1, 1)), ((0, 1, 1), (1, 0, 1), (1, 1, 2))])


def ply(form, faces, body, colours=""):
    head = f"ply\nformat {form} 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n{colours}"
    head += f"element face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
    return head.encode() + body


PLACES = [(0, 0, 1), (1, 0, 1), (0, 1, 1), (1, 1, 2)]
ASCII = b"0 0 1\n1 0 1\n0 1 1\n1 1 2\n"


def binary(order):
    places = b"".join(struct.pack(f"{order}3f", *place) for place in PLACES)
    return places + struct.pack(f"{order}B3i", 3, 0, 1, 2) + struct.pack(f"{order}B3i", 3, 1, 3, 2)


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("m.obj", f"# caf\xe9\n{VERTICES}f 1 2 3\nf 2 4 3\n".encode("latin-1")),
        ("groups.obj", f"mtllib no.mtl\no a\n{VERTICES}g one\nusemtl x\nf 1 2 3\ng two\nusemtl y\nf 2 4 3\n".encode()),
        ("uv.OBJ", f"{VERTICES}vt 0 0\nvt 1 1\nvn 0 0 1\nf 1/1/1 2/2/1 3/2/1\nf 2/1/1 4/1/1 3/1/1\n".encode()),
        ("normals.obj", f"{VERTICES}vn 0 0 1\nf 1//1 2//1 3//1\nf 2//1 4//1 3//1\nl 1 2\n".encode()),
        ("a.ply", ply("ascii", 2, ASCII + b"3 0 1 2\n3 1 3 2\n")),
        ("le.ply", ply("binary_little_endian", 2, binary("<"))),
        ("be.ply", ply("binary_big_endian", 2, binary(">"))),
    ],
)
def test_a_mesh_is_the_same_triangles_in_every_form(tmp_path, name, data):
    (tmp_path / name).write_bytes(data)
    mesh = read_mesh(tmp_path / name)
    assert corners(mesh) == TWO
    np.testing.assert_array_equal(mesh.intensity, np.ones((2, 3)))


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("m.obj", b"v 0 0 1\nv 2 0 1\nv 3 2 1\nv 1 3 1\nv -1 2 1\nf 1 2 3 4 5\n"),
        (
            "m.ply",
            ply("ascii", 1, b"0 0 1\n2 0 1\n3 2 1\n1 3 1\n-1 2 1\n5 0 1 2 3 4\n").replace(b"vertex 4", b"vertex 5"),
        ),
    ],
)
def test_a_polygon_becomes_triangles_that_cover_it_once_and_run_the_same_way_round(tmp_path, name, data):
    (tmp_path / name).write_bytes(data)
    mesh = read_mesh(tmp_path / name)
    a, b, c = np.moveaxis(mesh.vertices_m[mesh.faces], 1, 0)
    areas = np.cross(b - a, c - a)[:, 2] / 2
    assert len(areas) == 3 and np.all(areas > 0) and areas.sum() == pytest.approx(8.0)  # by the shoelace formula


def test_colours_of_vertices_and_faces_become_luminance(tmp_path):
    (tmp_path / "v.obj").write_text("v 0 0 1 1 0 0\nv 1 0 1 0 1 0\nv 0 1 1 0.2 0.2 0.2\nf 1 2 3\n")
    mesh = read_mesh(tmp_path / "v.obj")
    light = dict(zip(map(tuple, mesh.vertices_m[mesh.faces[0]].tolist()), mesh.intensity[0], strict=True))
    assert light == {
        (0, 0, 1): pytest.approx(0.2126, abs=1e-6),
        (1, 0, 1): pytest.approx(0.7152, abs=1e-6),
        (0, 1, 1): pytest.approx(0.2, abs=1e-6),
    }
    srgb = read_mesh(tmp_path / "v.obj", srgb=True)
    assert srgb.intensity.min() == pytest.approx(((0.2 + 0.055) / 1.055) ** 2.4, rel=1e-5)
    data = ply("ascii", 2, ASCII + b"3 0 1 2 0 0 255\n3 1 3 2 255 255 255\n")
    named = b"vertex_indices\n" + b"".join(b"property uchar %s\n" % name for name in (b"red", b"green", b"blue"))
    (tmp_path / "f.ply").write_bytes(data.replace(b"vertex_indices\n", named))
    np.testing.assert_allclose(read_mesh(tmp_path / "f.ply").intensity, [[0.0722] * 3, [1] * 3], atol=1e-6)


@pytest.mark.parametrize(
    ("name", "data", "said"),
    [
        ("m.stl", b"solid\n", "not an .obj or .ply"),
        ("m.obj", b"", "no faces"),
        ("m.obj", VERTICES.encode(), "no faces"),
        ("m.obj", f"{VERTICES}l 1 2\n".encode(), "no faces"),
        ("m.obj", b"\x00\x01\xff", "null bytes"),
        ("m.obj", f"{VERTICES}f 1 2 3\nf 1 2 9\n".encode(), "line 6: a face names vertex 9; there are vertices 1 to 4"),
        ("m.obj", f"{VERTICES}f 0 1 2\n".encode(), "line 5: a face names vertex 0"),
        ("m.obj", f"{VERTICES}f -1 -2 -3\n".encode(), "line 5: a face names vertex -1; .*absolute indices"),
        ("m.obj", f"{VERTICES}f 1 2\n".encode(), "line 5: 'f 1 2' is not a face of three"),
        ("m.obj", f"{VERTICES}f 1 2 x\n".encode(), "line 5: 'f 1 2 x' is not a face"),
        ("m.obj", b"v 0 0 1\nv nan 0 1\nv 0 1 1\nf 1 2 3\n", "line 2: 'v nan 0 1' is not a vertex"),
        ("m.obj", b"v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n", "line 1: 'v 0 0' is not a vertex of three"),
        ("m.obj", b"v 0 0 1\nv 1 O 1\nv 0 1 1\nf 1 2 3\n", "line 2: 'v 1 O 1'"),
        ("m.ply", b"", "not a PLY file"),
        ("m.ply", b"hello\n", "not a PLY file"),
        ("m.ply", ply("ascii", 0, ASCII), "no faces"),
        ("m.ply", ply("ascii", 1, ASCII + b"3 0 1 9\n"), "1 corners .* not there, the first 9; .* 0 to 3"),
        ("m.ply", ply("ascii", 1, ASCII + b"3 0 1 -1\n"), "the first -1"),
        ("m.ply", ply("ascii", 2, ASCII + b"3 0 1 2\n"), "cut short: 5 lines below the header, which says 6"),
        (
            "m.ply",
            ply("ascii", 1, b"nan 0 1\n1 0 1\n0 1 1\n1 1 2\n3 0 1 2\n"),
            "1 vertices are not finite, .* vertex 0",
        ),
        ("m.ply", ply("binary_little_endian", 2, binary("<")[:-5]), "cannot be read as a mesh"),
        ("m.ply", ply("ascii", 999_999_999, ASCII), "says that it has 1000000003 elements"),
    ],
)
def test_a_mesh_that_cannot_be_is_refused(tmp_path, name, data, said):
    (tmp_path / name).write_bytes(data)
    refused(read_mesh, tmp_path / name, said)


def test_a_mesh_that_is_not_there_is_refused(tmp_path):
    refused(read_mesh, tmp_path / "no.obj", "cannot be read")


# -- light fields -----------------------------------------------------------------------------------------------------


def views(*places, head="", image="sub/ramp.png"):
    return f"schema = 1\n{head}" + "".join(f'[[view]]\nimage = "{image}"\npupil_mm = {place}\n' for place in places)


def test_views_are_read_with_their_places_in_metres(images):
    text = views([0, 0], [1.0, -0.5], head="distance_m = 0.5\nconverging = true\n") + (
        '[[view]]\nimage = "black.png"\npupil_mm = [-1.0, 1.0]\n'
    )
    scene = read_light_field(listed(images, text))
    assert [view.pupil_m for view in scene.views] == [(0.0, 0.0), (1e-3, -0.5e-3), (-1e-3, 1e-3)]
    np.testing.assert_array_equal(scene.views[1].intensity, read_scene(images / "sub/ramp.png"))
    assert (scene.distance_m, scene.converging) == (0.5, True)
    assert scene.aperture_m == pytest.approx(np.sqrt(1.25) * 1e-3)  # the nearest two


def test_the_aperture_is_the_whole_pupil_for_one_view_and_what_the_file_says_where_it_does(images):
    one = read_light_field(listed(images, views([0.5, 0])))
    assert (one.aperture_m, one.distance_m, one.converging) == (None, np.inf, False)
    assert read_light_field(listed(images, views([0, 0], [0, 0], head="aperture_mm = 0.7\n"))).aperture_m == 0.7e-3


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("schema = 1\n", "view is missing"),
        ("schema = 1\nview = []\n", "view"),
        (views([0, 0], [1, 1], [0, 0]), r"views 1 and 3 are 0 mm apart, at pupil_mm = \[0.0, 0.0\]"),
        (views([0]), "view 1: pupil_mm has too few values"),
        (views([0, 0, 0]), "view 1: pupil_mm"),
        (views([0, 0], [0, 11]), "view 2: pupil_mm = 11 is not at most 10"),
        (views([0, 0], head="distance_m = 0\n"), "distance_m = 0 is not greater than 0"),
        (views([0, 0], head="aperture_mm = 0\n"), "aperture_mm = 0 is not greater than 0"),
        (views([0, 0], head="depth_m = 1\n"), "unknown key depth_m"),
        (views([0, 0]) + "pupil_m = [0, 0]\n", "view 1: unknown key pupil_m. Did you mean pupil_mm"),
        (views([0, 0], image="no.png"), "view 1: image = 'no.png' is not a file"),
        (views([0, 0], image="black.png"), "every view is black"),
        (
            views([0, 0]) + '[[view]]\nimage = "small.png"\npupil_mm = [1, 1]\n',
            "view 2: image = 'small.png' has 2 x 2 pixels; 4 x 3 are needed",
        ),
    ],
)
def test_views_that_cannot_be_are_refused_naming_view_and_key(images, text, said):
    refused(read_light_field, listed(images, text), said)
