"""Readers of exported scenes, which read them as their renderers would: cameras, triangles, materials, skies.

Each reader follows the renderer's documentation, not the code that writes the export. `Scene.ray(x, y)` is the ray of a
point in the image, from (0, 0) in the upper left corner to (1, 1). `Scene.sky(directions)` is the sky's radiance.
"""

import json
import math
import re
import struct
import types
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import map_coordinates
from support import fake_bpy, fake_raysect

from mi_refract.io.image_file import read_exr


@dataclass
class Scene:
    """A scene as a renderer reads it.

    By mesh: `triangles`, `indices` (inside over outside), `lights` (radiance), `colours` (reflectance). `lamps`: a
    function of `lamp` for each lamp without size.
    """

    size: tuple[int, int]
    depth: int
    ray: Callable
    sky: Callable
    triangles: dict = field(default_factory=dict)
    indices: dict = field(default_factory=dict)
    lights: dict = field(default_factory=dict)
    colours: dict = field(default_factory=dict)
    lamps: dict = field(default_factory=dict)


def unit(vector):
    return np.asarray(vector) / np.linalg.norm(vector)


def pinhole(origin, forward, up, half_width, half_height):
    """Return the function `ray` of a camera; `half_width`, `half_height`: tangents of half the angles of view."""
    forward = unit(forward)
    right = unit(np.cross(forward, up))
    upward = np.cross(right, forward)

    def ray(x, y):
        return np.asarray(origin), forward + (2 * x - 1) * half_width * right + (1 - 2 * y) * half_height * upward

    return ray


def lamp(colour, position=None, direction=None, falloff=lambda angle: 1.0):
    """Return a function of a point: the direction to the lamp, and the irradiance of a surface that faces the lamp.

    `falloff`: a function of the angle from `direction` in radians.
    """

    def irradiance(point):
        to_lamp = -np.asarray(direction) if position is None else np.subtract(position, point)
        angle = 0.0 if direction is None else np.arccos(np.clip(unit(direction) @ -unit(to_lamp), -1, 1))
        return unit(to_lamp), np.array(colour) * falloff(angle) / (1 if position is None else to_lamp @ to_lamp)

    return irradiance


def linear(table, rows, columns):
    """Interpolate linearly between the numbers of a table (H, W)."""
    return map_coordinates(table, [rows, columns], order=1, mode="nearest")


def on_map(path, coordinates):
    """Return the sky of a map. `coordinates(x, y, z)`: position in the map, from the left and the top, 0 to 1."""
    pixels = np.pad(read_exr(path)[0].astype(float), [(0, 0), (1, 1), (0, 0)], mode="wrap")
    height, width = pixels.shape[0], pixels.shape[1] - 2

    def sky(directions):
        u, v = coordinates(*directions.T)
        return np.stack([linear(x, v * height - 0.5, u % 1 * width + 0.5) for x in np.moveaxis(pixels, -1, 0)], -1)

    return sky


def plain_sky(colour):
    return lambda directions: np.broadcast_to(np.array(colour, float), directions.shape)


def ply(path):
    header, _, data = path.read_bytes().partition(b"end_header\n")
    vertices, faces = (int(number) for number in re.findall(rb"element \w+ (\d+)", header))
    positions = np.frombuffer(data, "<f4", 3 * vertices).reshape(-1, 3)
    return positions[np.frombuffer(data, [("n", "u1"), ("i", "<i4", 3)], faces, 12 * vertices)["i"]]


def readme(folder, pattern):
    return [int(number) for number in re.search(pattern, (folder / "README.txt").read_text()).groups()]


def radiance(folder, monkeypatch):
    """Read a Radiance export. An interface names the medium behind its normal first; a view has both full angles."""
    words = (folder / "camera.vf").read_text().split()
    assert words[:2] == ["VIEW=", "-vtv"]
    view = {name: np.array(words[words.index(name) + 1 :][:3], float) for name in ("-vp", "-vd", "-vu")}
    half_width, half_height = (np.tan(np.radians(float(words[words.index(name) + 1])) / 2) for name in ("-vh", "-vv"))
    width, height, *depths = readme(folder, r"-x (\d+) -y (\d+) -pa 0 [^$]*?-ab (\d+) [^$]*?-lr -(\d+) ")
    assert depths[0] == depths[1]
    scene = Scene(
        (width, height), depths[0] + 1, pinhole(*view.values(), half_width, half_height), plain_sky((0, 0, 0))
    )
    surfaces = {}
    for line in filter(None, (folder / "scene.rad").read_text().splitlines()):
        modifier, kind, name, *rest = line.split()
        numbers = [float(x) for x in rest[3 + int(rest[0]) :]]
        if kind == "polygon":
            mesh = name.rpartition(".")[0]
            scene.triangles.setdefault(mesh, []).append(np.reshape(numbers, (3, 3)))
            kind, numbers = surfaces[modifier]
            if kind == "interface":
                scene.indices[mesh] = numbers[3] / numbers[7]
            else:
                {"glow": scene.lights, "plastic": scene.colours}[kind][mesh] = numbers[:3]
        elif kind == "source":
            assert modifier == "sky" and numbers[3] == 360
            glow = surfaces["sky"][1]
            scene.sky = _radiance_sky(folder, glow) if "map" in surfaces else plain_sky(glow[:3])
        else:
            surfaces[name] = kind, numbers
    return scene


def _radiance_sky(folder, glow):
    """Read the sky: `sky.cal` computes the row and the column in the tables, which are interpolated linearly."""
    assert glow == [1, 1, 1, 0]
    code, tables = (folder / "sky.cal").read_text().replace(";", ""), []
    for colour in "rgb":
        dimensions, *sizes = (folder / f"sky_{colour}.dat").read_text().splitlines()
        tables.append(np.array([line.split() for line in sizes[2:]], float))
        assert dimensions == "2" and [line.split()[2] for line in sizes[:2]] == [str(x) for x in tables[-1].shape]

    def sky(directions):
        names = dict(zip(("Dx", "Dy", "Dz"), directions.T, strict=True))
        names |= {"PI": np.pi, "Acos": np.arccos, "atan2": np.arctan2, "floor": np.floor}
        exec(code, names)
        return np.stack([linear(table, names["row"], names["column"]) for table in tables], -1)

    return sky


def luxcore(folder, monkeypatch):
    """Read a LuxCore export. ±1 in the screen window is half the field of view; LuxCore's film is one row off."""
    properties = {}
    for line in ((folder / "scene.scn").read_text() + (folder / "scene.cfg").read_text()).splitlines():
        key, _, text = line.partition(" = ")
        properties[key] = text.strip('"') if '"' in text else [float(x) for x in text.split()]
    camera = {key.removeprefix("scene.camera."): value for key, value in properties.items()}
    tangent = np.tan(np.radians(camera["fieldofview"][0]) / 2)
    left, right, bottom, top = camera["screenwindow"]
    width, height = (int(properties[f"film.{name}"][0]) for name in ("width", "height"))
    origin = np.array(camera["lookat.orig"])
    forward = unit(np.array(camera["lookat.target"]) - origin)
    sideways = unit(np.cross(forward, camera["up"]))

    def ray(x, y):
        across, above = left + x * (right - left), top - (y - 1 / height) * (top - bottom)
        return origin, forward + tangent * (across * sideways + above * np.cross(sideways, forward))

    (depth,) = {properties[f"path.pathdepth.{name}"][0] for name in ("total", "diffuse", "glossy", "specular")}
    scene = Scene((width, height), int(depth), ray, plain_sky((0, 0, 0)))
    if properties.get("scene.lights.sky.type") == "infinite":
        assert properties["scene.lights.sky.wrap"] == "clamp"

        def coordinates(x, y, z):
            return np.arctan2(y, x) / (2 * np.pi), np.arccos(z) / np.pi

        scene.sky = on_map(folder / properties["scene.lights.sky.file"], coordinates)
    elif "scene.lights.sky.type" in properties:
        scene.sky = plain_sky(properties["scene.lights.sky.color"])
    for key, file in properties.items():
        if match := re.fullmatch(r"scene\.objects\.(\w+)\.ply", key):
            name = match[1]
            material = f"scene.materials.{properties[f'scene.objects.{name}.material']}"
            scene.triangles[name] = ply(folder / file)
            if properties[f"{material}.type"] == "glass":
                inside, outside = (properties[f"{material}.{side}ior"][0] for side in ("interior", "exterior"))
                scene.indices[name] = inside / outside
            elif f"{material}.emission" in properties:
                scene.lights[name] = properties[f"{material}.emission"]
            else:
                scene.colours[name] = properties[f"{material}.kd"]
    return scene


def povray(folder, monkeypatch):
    """Read a POV-Ray export. A ray's direction is direction + (x − ½) right + (½ − y) up.

    `dx`, `dy` are the position in the pixel.
    """
    text = (folder / "scene.pov").read_text()

    def vectors(part):
        return [np.array(v.split(","), float) for v in re.findall(r"<([^<>]*)>", part)]

    (right,), (up,) = (vectors(re.search(rf"#declare {name} = (.*);", text)[1]) for name in ("Right", "Up"))
    origin, forward = vectors(re.search(r"location[^#]*?direction <[^>]*>", text)[0])
    pattern = r"direction <[^>]*> \+ Right\*\(dx - 0\.5\)/(\d+) - Up\*\(dy - 0\.5\)/(\d+) }"
    shift = [int(count) for count in re.search(pattern, text).groups()]
    assert "right Right up Up" in text
    size = readme(folder, r"\+W(\d+) \+H(\d+) ")

    def ray(x, y):
        (i, dx), (j, dy) = ((int(a * n), a * n - int(a * n)) for a, n in zip((x, y), size, strict=True))
        direction = forward + right * (dx - 0.5) / shift[0] - up * (dy - 0.5) / shift[1]
        return origin, direction + ((i + 0.5) / size[0] - 0.5) * right + (0.5 - (j + 0.5) / size[1]) * up

    scene = Scene(tuple(size), int(re.search(r"max_trace_level (\d+)", text)[1]), ray, None)
    if "sky_sphere" in text:
        assert "map_type 1 " in text

        def coordinates(x, y, z):
            return np.arctan2(z, x) / (2 * np.pi), 0.5 - np.arcsin(y) / np.pi

        scene.sky = on_map(folder / re.search(r'exr "(.*?)"', text)[1], coordinates)
    else:
        scene.sky = plain_sky(vectors(re.search(r"background \{ rgb (.*) }", text)[1])[0])
    for part in text.split("mesh2 { // ")[1:]:
        name = part.split()[0]
        vertices, faces, surface = re.split(r"face_indices|(?=texture \{ pigment)", part, maxsplit=2)
        # Clockwise in POV-Ray's left-handed coordinates is counterclockwise in right-handed ones.
        scene.triangles[name] = np.array(vectors(vertices))[np.array(vectors(faces), int)[:, ::-1]]
        if match := re.search(r"interior \{ ior ([-+.\de]+) }", surface):
            scene.indices[name] = float(match[1])
        else:
            front, back = surface.split("interior_texture")
            assert "emission 1" in front and "emission" not in back
            scene.lights[name] = vectors(front)[0]
    return scene


def cycles(folder, monkeypatch):
    """Read the objects that the script of a Cycles export creates. A camera looks along −z; +y is up in its image.

    The shader of a light mixes an emitter on the front and black on the back.
    """
    bpy = fake_bpy.run(folder, monkeypatch)
    scene, data = bpy.context.scene, bpy.data
    matrix, lens = scene.camera.matrix_world, scene.camera.data
    assert lens is data.cameras.made["camera"] and lens.sensor_fit == "HORIZONTAL"
    assert lens.sensor_width >= 1 and lens.lens >= 1, "Blender's limits"
    size, half_width = (scene.render.resolution_x, scene.render.resolution_y), lens.sensor_width / (2 * lens.lens)

    def ray(x, y):
        local = np.array([(2 * x - 1) * half_width, (1 - 2 * y) * half_width * size[1] / size[0], -1])
        return matrix[:3, 3], np.asarray(matrix[:3, :3] @ local)

    (depth,) = {getattr(scene.cycles, f"{name}_bounces") for name in ("max", "diffuse", "glossy", "transmission")}
    result = Scene(size, depth + 2, ray, None)
    world = scene.world.node_tree
    background, _ = world.source(world.only("ShaderNodeOutputWorld"), "Surface")
    if colour := background.inputs["Color"].default_value:
        result.sky = plain_sky(colour[:3])
    else:
        assert world.source(background, "Color")[0].kind == "ShaderNodeTexEnvironment"
        (path,) = bpy.data.images.load.call_args.args

        def coordinates(x, y, z):
            return 0.5 - np.arctan2(y, x) / (2 * np.pi), np.arccos(z) / np.pi

        result.sky = on_map(path, coordinates)
    for name, settings in data.lights.made.items():
        item, sun = data.objects.made[name], settings.kind == "SUN"
        assert item.data is settings and (settings.angle if sun else settings.shadow_soft_size) == 0
        colour = np.multiply(settings.color, settings.energy) / (1 if sun else 4 * np.pi)  # W/m², or W
        position = None if sun else item.matrix_world[:3, 3]
        result.lamps[name] = lamp(colour, position, -item.matrix_world[:3, 2] if sun else None)
    for name, mesh in data.meshes.made.items():
        ((vertices, _, faces), _) = mesh.from_pydata.call_args
        result.triangles[name] = np.array(vertices)[np.array(faces)]
        (material,) = mesh.materials
        tree = material.node_tree
        surface, _ = tree.source(tree.only("ShaderNodeOutputMaterial"), "Surface")
        value = {key: socket.default_value for key, socket in surface.inputs.items()}
        if surface.kind == "ShaderNodeBsdfGlass":
            assert (value["Roughness"], value["Color"]) == (0, (1, 1, 1, 1))
            result.indices[name] = value["IOR"]
        elif surface.kind == "ShaderNodeBsdfDiffuse":
            assert value["Roughness"] == 0
            result.colours[name] = value["Color"][:3]
        else:
            assert tree.source(surface, 0)[1] == "Backfacing"
            (front, _), (back, _) = (tree.source(surface, i) for i in (1, 2))
            assert (front.kind, back.inputs["Color"].default_value[:3]) == ("ShaderNodeEmission", (0, 0, 0))
            inputs = front.inputs
            result.lights[name] = np.array(inputs["Color"].default_value[:3]) * inputs["Strength"].default_value
    return result


def raysect(folder, monkeypatch):
    """Read the objects that the script of a raysect export creates, at their original scale.

    A camera looks along +z; +x is left in its image.
    """
    recorded, script = fake_raysect.run(folder, monkeypatch)
    plain = json.loads((folder / "scene.json").read_text())
    script["build"](plain, folder)
    unit = script["scale"](plain, folder)
    camera = script["camera"]("world", plain, types.SimpleNamespace(spp=3, band=None), "pipeline")
    assert camera.ray_extinction_prob == 0 and camera.ray_importance_sampling is False
    width, height = camera.pixels
    half, matrix = np.tan(np.radians(camera.fov) / 2) / max(width, height), np.asarray(camera.transform)

    def ray(x, y):
        local = np.array([(1 - 2 * x) * half * width, (1 - 2 * y) * half * height, 1])
        return matrix[:3, 3] / unit, matrix[:3, :3] @ local

    def bins(spectrum):
        """Return red, green and blue, each constant between two wavelengths."""
        values = list(spectrum.values())
        assert values[::2] == values[1::2] and min(np.diff(list(spectrum))) > 0
        return values[::2]

    def radiance_of_map(direction):
        vector = types.SimpleNamespace(**dict(zip("xyz", direction, strict=True)))
        vector.normalise = lambda: vector
        spectrum = types.SimpleNamespace(samples=np.zeros(3))
        ray = types.SimpleNamespace(direction=vector, new_spectrum=lambda: spectrum)
        return recorded.sky.evaluate_surface("world", ray).samples

    if isinstance(recorded.sky, script["Map"]):
        sky = lambda directions: np.array(list(map(radiance_of_map, directions)))  # noqa: E731
    else:
        sky = plain_sky(bins(recorded.sky.spectrum))
    scene = Scene((width, height), camera.ray_max_depth, ray, sky)
    for name, mesh in recorded.meshes.items():
        scene.triangles[name] = mesh.triangles / unit
        if isinstance(mesh.material, fake_raysect.Emitter):
            scene.lights[name] = bins(mesh.material.spectrum)
        elif mesh.material[0] == "glass":
            _, inside, transmission, outside = mesh.material
            assert transmission == 1
            scene.indices[name] = inside / outside
        else:
            scene.colours[name] = bins(mesh.material[1])
    return scene


def obj(folder, monkeypatch):
    """Read an export to obj+json, as its README.txt describes it."""
    document = json.loads((folder / "scene.json").read_text())
    camera = document["camera"]
    size, half_width = (camera["width"], camera["height"]), np.tan(np.radians(camera["fov_x_degrees"]) / 2)
    forward = np.subtract(camera["target"], camera["origin"])
    ray = pinhole(camera["origin"], forward, camera["up"], half_width, half_width * size[1] / size[0])
    scene = Scene(size, document["max_depth"], ray, None)
    if "environment" in document["sky"]:

        def coordinates(x, y, z):
            return np.arctan2(x, -z) / (2 * np.pi), np.arccos(y) / np.pi

        scene.sky = on_map(folder / document["sky"]["environment"], coordinates)
    else:
        scene.sky = plain_sky(document["sky"]["radiance"])
    for entry in document.get("lamps", []):
        colour = entry["irradiance" if entry["type"] == "directional" else "intensity"]
        cone = [math.radians(entry.get(f"{name}_degrees", 0)) for name in ("beam", "cutoff")]
        falloff = lambda angle, cone=cone: np.interp(angle, cone, [1, 0])  # noqa: E731
        options = {"falloff": falloff} if entry["type"] == "spot" else {}
        scene.lamps[entry["name"]] = lamp(colour, entry.get("position"), entry.get("direction"), **options)
    library, vertices = {}, []
    for part in (folder / "scene.mtl").read_text().split("newmtl ")[1:]:
        name, *lines = part.splitlines()
        library[name] = {word: [float(x) for x in rest] for word, *rest in map(str.split, lines)}
    for line in (folder / "scene.obj").read_text().splitlines():
        word, *rest = line.split()
        if word == "o":
            name = rest[0]
            material = document["materials"][document["meshes"][name]["material"]]
        elif word == "usemtl":
            entry = library[rest[0]]
            if material["type"] == "glass":
                scene.indices[name] = entry["Ni"][0]
                assert np.isclose(material["int_ior"] / material["ext_ior"], entry["Ni"][0], rtol=1e-15)
            else:
                key, values = {"light": ("Ke", scene.lights), "diffuse": ("Kd", scene.colours)}[material["type"]]
                values[name] = entry[key]
                assert entry[key] in (material.get("radiance"), material.get("reflectance"))
        elif word == "v":
            vertices.append([float(x) for x in rest])
        elif word == "f":
            scene.triangles.setdefault(name, []).append([vertices[int(i) - 1] for i in rest])
    return scene


@dataclass
class Model:
    """A glTF file: `tree` is its JSON; `meshes` has positions, normals, triangles (as indices) and material by name."""

    tree: dict
    meshes: dict


def glb(path):
    """Read a binary glTF file by its specification: a header, a chunk of JSON, a chunk of binary data."""
    data = path.read_bytes()
    assert data[:4] == b"glTF" and struct.unpack("<2I", data[4:12]) == (2, len(data))
    length, kind = struct.unpack("<I4s", data[12:20])
    assert kind == b"JSON" and data[24 + length : 28 + length] == b"BIN\0"
    return model(json.loads(data[20 : 20 + length]), data[28 + length :])


def model(tree, data):
    """Read a model from its JSON and its binary data."""

    def array(index):
        accessor = tree["accessors"][index]
        view = tree["bufferViews"][accessor["bufferView"]]
        kind, width = {5125: "<u4", 5126: "<f4"}[accessor["componentType"]], {"SCALAR": 1, "VEC3": 3}[accessor["type"]]
        start = view["byteOffset"] + accessor.get("byteOffset", 0)
        return np.frombuffer(data, kind, accessor["count"] * width, start).reshape(-1, width)

    result, views = Model(tree, {}), [accessor["bufferView"] for accessor in tree.get("accessors", [])]
    shared = {view for view in views if views.count(view) > 1}
    assert all("byteStride" in tree["bufferViews"][view] for view in shared), "by the specification"
    for node in tree["nodes"]:
        if "mesh" in node:
            assert not {"matrix", "translation", "rotation", "scale"} & node.keys()
            (primitive,) = tree["meshes"][node["mesh"]]["primitives"]
            attributes = primitive["attributes"]
            accessors = attributes["POSITION"], attributes["NORMAL"], primitive["indices"]
            vertices, normals, indices = map(array, accessors)
            material = tree["materials"][primitive["material"]]
            result.meshes[node["name"]] = vertices, normals, indices.reshape(-1, 3), material
    return result


def punctual(tree):
    """Return for each light of KHR_lights_punctual the name and the matrix of its node, and its entry."""
    nodes = [tree["nodes"][i] for i in tree["scenes"][0]["nodes"]]
    nodes = [node for node in nodes if "KHR_lights_punctual" in node.get("extensions", {})]
    lights = tree["extensions"]["KHR_lights_punctual"]["lights"] if nodes else []
    assert not nodes or "KHR_lights_punctual" in tree["extensionsUsed"]
    assert [node["extensions"]["KHR_lights_punctual"]["light"] for node in nodes] == list(range(len(lights)))
    matrices = (np.reshape(node["matrix"], (4, 4)).T for node in nodes)
    return [(node["name"], matrix, light) for node, matrix, light in zip(nodes, matrices, lights, strict=True)]


def cone(innerConeAngle, outerConeAngle):
    """Return the falloff in the sample code of the extension, a function of the angle in radians."""
    scale = 1 / max(0.001, math.cos(innerConeAngle) - math.cos(outerConeAngle))
    return lambda angle: np.clip((np.cos(angle) - math.cos(outerConeAngle)) * scale, 0, 1) ** 2


def gltf(folder, monkeypatch):
    """Read a glTF export, whose two files must be equal. A camera looks along −z; +y is up in its image."""
    read = glb(folder / "scene.glb")
    tree = json.loads((folder / "scene.gltf").read_text())
    from_json = model(tree, (folder / tree["buffers"][0]["uri"]).read_bytes())
    assert from_json.tree | {"buffers": 0, "bufferViews": 0} == read.tree | {"buffers": 0, "bufferViews": 0}
    for name, mesh in read.meshes.items():
        assert all((a == b).all() for a, b in zip(mesh[:3], from_json.meshes[name][:3], strict=True))
    (node,) = (node for node in tree["nodes"] if "camera" in node)
    matrix, view = np.reshape(node["matrix"], (4, 4)).T, tree["cameras"][node["camera"]]["perspective"]
    extras, half_height = tree["scenes"][0]["extras"], np.tan(view["yfov"] / 2)
    half_width = half_height * view["aspectRatio"]

    def ray(x, y):
        return matrix[:3, 3], matrix[:3, :3] @ [(2 * x - 1) * half_width, (1 - 2 * y) * half_height, -1]

    def coordinates(x, y, z):
        return 0.5 + np.arctan2(z, x) / (2 * np.pi), np.arccos(y) / np.pi

    sky = on_map(folder / "sky.exr", coordinates)
    scene = Scene((extras["width"], extras["height"]), extras["max_depth"], ray, sky)
    for name, frame, light in punctual(tree):
        colour = np.multiply(light["color"], light["intensity"])
        if light["type"] == "directional":
            scene.lamps[name] = lamp(colour, None, -frame[:3, 2])
        elif light["type"] == "spot":
            scene.lamps[name] = lamp(colour, frame[:3, 3], -frame[:3, 2], cone(**light["spot"]))
        else:
            scene.lamps[name] = lamp(colour, frame[:3, 3])
    for name, (vertices, _, faces, material) in read.meshes.items():
        scene.triangles[name] = vertices[faces]
        extensions, base = material["extensions"], material["pbrMetallicRoughness"]
        assert set(extensions) <= set(tree["extensionsUsed"])
        assert (base["metallicFactor"], base["roughnessFactor"]) == (0, 0)
        index = extensions["KHR_materials_ior"]["ior"]
        if "KHR_materials_transmission" in extensions:
            assert extensions["KHR_materials_transmission"] == {"transmissionFactor": 1}
            assert base["baseColorFactor"] == [1, 1, 1, 1] and extensions["KHR_materials_volume"]["thicknessFactor"] > 0
            scene.indices[name] = index
            continue
        assert index == 1 and extensions["KHR_materials_specular"] == {"specularFactor": 0}
        if "emissiveFactor" in material:
            strength = extensions.get("KHR_materials_emissive_strength", {"emissiveStrength": 1})["emissiveStrength"]
            assert max(material["emissiveFactor"]) <= 1 and not any(base["baseColorFactor"][:3])
            scene.lights[name] = np.multiply(strength, material["emissiveFactor"])
        else:
            assert material["doubleSided"]
            scene.colours[name] = base["baseColorFactor"][:3]
    return scene


READERS = {"radiance": radiance, "luxcore": luxcore, "povray": povray, "cycles": cycles, "raysect": raysect}
READERS |= {"obj+json": obj, "gltf": gltf}
