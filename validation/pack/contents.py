"""The files of the pack: made from fixed seeds, in a fixed order, without dates."""

from __future__ import annotations

import csv
import functools
import hashlib
import io
import json
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from mi_refract import oracle
from mi_refract.accuracy import RayBounds
from mi_refract.formulas import FORMULAS, TEXTBOOK_BACKWARD
from mi_refract.io import image_file, reference_pack
from mi_refract.io.image_file import NO_DATE, Image, srgb_encode
from mi_refract.io.safe_files import temporary_folder
from mi_refract.ray_sets import files as ray_files
from mi_refract.ray_sets import ray_set
from mi_refract.ray_sets.tir_signal import LOOSEST
from mi_refract.rendering.long_render import render_to_exr
from mi_refract.scene_export import from_mitsuba, targets
from validation.reference import standard_numbers
from validation.run.context import SCENES

from . import structs

Files = dict[str, bytes]
HERE = Path(__file__).parent
TARGETS = {"mitsuba": "mitsuba", "obj+json": "obj", "gltf": "gltf"}  # target of `scene export` → folder in the pack
BEYOND_GLTF = ("furnace", "matched", "nested")  # scenes with glass within or in contact with other glass
# Samples per pixel: at most 3 % of noise, and a few minutes on two cores for all scenes. The other scenes cannot be
# represented as triangles of glass with one index, or take as long as all of these.
SPP = {
    "balls": 1024,
    "diamond": 512,
    "furnace": 256,
    "lightpipe": 256,
    "matched": 512,
    "nested": 512,
    "prism": 1024,
    "slab": 1024,
    "sphere": 1024,
}
SEED = 0
UNREPEATABLE = ("mi_refract:render_seconds", "mi_refract:machines", "mi_refract:scene")
COLUMNS = {
    "id": "of the ray",
    "transmitted": "1, or 0 for total internal reflection",
    "bx, by, bz (b)": "the exact direction after the surface, a unit vector; for total internal reflection, the mirror "
    "direction",
    "bx_low, by_low, bz_low (b_low)": "the rest of the exact direction: b + b_low has 106 bits",
    "cos_t": "the cosine of the angle of refraction; 0 for total internal reflection",
    "angle_limit": "radians: an answer farther from the exact direction is wrong",
    "length_limit": "an answer is wrong if its length differs by more, relative, from both 1 and |a|",
    "decided": "1 if an answer with the wrong `transmitted` is wrong; 0 if rounding errors may change it",
    "plane_limit": "limit of k × the error of a direction, across the plane of incidence or beyond what radicand_limit "
    "allows",
    "radicand_limit": "largest error of cos² of the angle of refraction, before its root is taken",
    "side_open": "1 if a ray is so close to the surface that rounding errors may put it on the other side",
}


ABOUT = {  # start of a path → what the file is
    "rays/limits": "the columns of certified answers, and the limits of all answers",
    "rays/certified": "exact answers to the rays, with the limits of each",
    "rays/": "rays: directions, normals, indices",
    "numbers/": "standard numbers: published or in closed form",
    "scenes/": "a scene as flat triangles, in the format of its folder",
    "images/images": "how the images were made",
    "images/": "reference image, linear, with the variance of a sample in NAME.variance",
    "looks/": "the reference image for viewing: sRGB, 16 bits",
    "schemas/": "JSON Schema of the JSON files that name it",
    "programs/": "a program in C that checks refraction against the rays",
    "README.md": "how to use the pack",
    "LICENSE": "the licence of the pack",
}


@dataclass(frozen=True)
class Size:
    """Scenes, rays per regime, pixels per side of an image, subdivision of curved shapes, and a divisor of SPP."""

    scenes: tuple[str, ...] = tuple(SPP)
    rays: int = ray_set.COUNT
    pixels: int = 128
    level: int = from_mitsuba.LEVEL
    less: int = 1


FULL, QUICK = Size(), Size(("balls", "nested", "prism"), rays=8, pixels=16, level=2, less=64)


@dataclass
class Contents:
    """The files made so far, and the entries of `rays/limits.json` and `images/images.json`."""

    size: Size
    files: Files = field(default_factory=dict)
    limits: dict[str, structs.RaysOfPrecision] = field(default_factory=dict)
    images: dict[str, structs.ReferenceImage] = field(default_factory=dict)

    def parts(self) -> list[tuple[str, Callable[[], None]]]:
        """Return the parts of the pack: a name, and a function that makes the part's files."""
        rays = [(f"rays in {x}", functools.partial(self.add_rays, x)) for x in ("f32", "f64")]
        scenes = [(f"scene {name}", functools.partial(self.add_scene, name)) for name in self.size.scenes]
        return [*rays, ("standard numbers", self.add_numbers), *scenes]

    def add_rays(self, precision: str) -> None:
        """Add the rays of `mi-refract rays export`, their certified answers, and the limits of answers to each ray."""
        rays = ray_set.make(count=self.size.rays, precision=precision)
        exact = oracle.refract(rays.rays.a, rays.rays.n, rays.rays.k, fresnel=False, progress=False)
        budget = FORMULAS[LOOSEST].budget
        bounds = RayBounds(rays.rays, exact, budget, rays.roundoff, normalised=True)
        columns: dict[str, NDArray[Any]] = {
            "id": rays.ids,
            "transmitted": exact.transmitted.astype(np.int64),
            "b": exact.direction,
            "b_low": exact.direction_low,
            "cos_t": exact.cos_t,
            "angle_limit": bounds.chord,
            "length_limit": bounds.length,
            "decided": bounds.decided.astype(np.int64),
            "plane_limit": budget.of_terms(bounds.u, bounds.k),
            "radicand_limit": budget.radicand_error_bound(bounds.u, bounds.k),
            "side_open": bounds.side_open.astype(np.int64),
        }
        if exact.undecided.any() or not all(np.isfinite(column).all() for column in columns.values()):
            raise ValueError(f"rays in {precision}: an answer or a limit is not finite; expected numbers")
        names: list[str] = []
        for name in columns:
            names += [f"b{axis}{name[1:]}" for axis in "xyz"] if name in ("b", "b_low") else [name]
        row = ",".join("%d" if name in ("id", "transmitted", "decided", "side_open") else "%r" for name in names)
        table = np.column_stack(list(columns.values())).tolist()
        lines = [f"# rays: {rays.header['checksum']}", ",".join(names), *(row % tuple(x) for x in table), ""]
        with temporary_folder() as folder:
            npz = ray_files.write(folder / "rays.npz", rays).read_bytes()
        ray_contents = {f"rays/{precision}.csv": ray_files.as_csv(rays).encode(), f"rays/{precision}.npz": npz}
        certified = {
            f"rays/certified-{precision}.csv": "\n".join(lines).encode(),
            f"rays/certified-{precision}.npz": ray_files.npz(columns),
        }
        self.files |= ray_contents | certified
        self.limits[precision] = structs.RaysOfPrecision(
            u=rays.roundoff,
            rays=list(ray_contents),
            certified=list(certified),
            checksum=rays.header["checksum"],
            regimes=rays.header["regimes"],
            error_bound=LOOSEST,
            backward_error_limit=TEXTBOOK_BACKWARD,
        )

    def add_numbers(self) -> None:
        """Add the table of standard numbers, as JSON and as CSV, with JSON in the cells of mappings."""
        rows, text = standard_numbers.rows(), io.StringIO()
        writer = csv.DictWriter(text, rows[0], lineterminator="\n")
        writer.writeheader()
        for row in rows:
            cells = {name: json.dumps(x, ensure_ascii=False) for name, x in row.items() if isinstance(x, dict)}
            writer.writerow(row | cells)
        self.files["numbers/standard_numbers.json"] = as_json(rows)
        self.files["numbers/standard_numbers.csv"] = text.getvalue().encode()

    def add_scene(self, name: str) -> None:
        """Add a scene as flat triangles in each format, and its image, rendered from those triangles."""
        plain = from_mitsuba.load(SCENES / f"{name}.xml", level=self.size.level, defines={"res": str(self.size.pixels)})
        for target, subfolder in TARGETS.items():
            if target == "gltf" and name in BEYOND_GLTF:
                continue
            for file, content in targets.TARGETS[target](plain).items():
                self.files[f"scenes/{name}/{subfolder}/{file}"] = content
        path, spp = f"scenes/{name}/mitsuba/scene.xml", max(2, SPP[name] // self.size.less)
        # By default Mitsuba's own plugin renders the scene; -D bsdf=refract selects this package's plugin.
        own, builtin = (f'<default name="bsdf" value="{plugin}"/>'.encode() for plugin in ("refract", "dielectric"))
        if self.files[path].count(own) != 1:
            raise ValueError(f"{path}: expected {own.decode()}")
        self.files[path] = self.files[path].replace(own, builtin)
        with temporary_folder() as folder:
            for file, content in self.files.items():
                if Path(file).parent == Path(path).parent:
                    (folder / Path(file).name).write_bytes(content)
            rendered = folder / "rendered.exr"
            render_to_exr(folder / "scene.xml", rendered, defines={"bsdf": "refract"}, spp=spp, seed=SEED)
            image = image_file.read(rendered)
            header = {key: x for key, x in image.metadata.items() if key.startswith("mi_refract:") or key == "Software"}
            header = {key: x for key, x in header.items() if key not in UNREPEATABLE} | {"mi_refract:scene": path}
            image_file.write_exr(folder / "image.exr", image.pixels, image.channels, header | NO_DATE)
            self.files[f"images/{name}.exr"] = (folder / "image.exr").read_bytes()
            self.files[f"looks/{name}.png"] = png(image, folder)
        mean, variance = (image.select([f"{x}{kind}" for x in "RGB"]) for kind in ("", ".variance"))
        noise = np.sqrt(variance.mean(dtype=np.float64) / spp) / mean.mean(dtype=np.float64)
        self.images[name] = structs.ReferenceImage(path, spp, SEED, float(f"{noise:.3g}"))

    def whole(self, version: str, quick: bool, made_with: dict[str, str]) -> Files:
        """Return all files of the pack: those of the parts, their summaries, texts, schemas, index and digests."""
        import jinja2

        limits = structs.Limits(COLUMNS, self.limits)
        summaries = {"images/images.json": self.images, "rays/limits.json": limits}
        files = self.files | {path: as_json(msgspec.to_builtins(value)) for path, value in summaries.items()}
        files |= structs.schemas() | {f"programs/{x}": (HERE / x).read_bytes() for x in ("check_rays.c", "judge.h")}
        files["LICENSE"] = HERE.parents[1].joinpath("LICENSE").read_bytes()
        template = jinja2.Template((HERE / "readme.md.j2").read_text("utf-8"), undefined=jinja2.StrictUndefined)
        text = template.render(version=version, images=self.images, beyond_gltf=BEYOND_GLTF)
        files["README.md"] = f"{text}\n".encode()
        entries = {}
        for path in sorted(files):
            description = next(text for start, text in ABOUT.items() if path.startswith(start))
            digest = hashlib.sha256(files[path]).hexdigest()
            entries[path] = reference_pack.PackedFile(digest, description, structs.schema_path(path))
        index = reference_pack.PackIndex(reference_pack.FORMAT, version, quick, made_with, entries)
        files[reference_pack.INDEX] = as_json(msgspec.to_builtins(index))
        for path, content in files.items():
            structs.check(path, content)
        return files | {reference_pack.SUMS: reference_pack.sums(files[reference_pack.INDEX], entries).encode()}


def png(image: Image, folder: Path) -> bytes:
    """Return the colours as a PNG file, sRGB, 16 bits; values above 1 are clipped."""
    import OpenImageIO as oiio

    pixels = np.ascontiguousarray(srgb_encode(np.clip(image.select("RGB"), 0, 1)), np.float32)
    path = folder / "look.png"
    buffer = oiio.ImageBuf(pixels)
    if not buffer.write(str(path), "uint16"):
        raise OSError(f"{path}: {image_file.one_line(buffer.geterror())}")
    return path.read_bytes()


def as_json(value: Any) -> bytes:
    """Return strict JSON, indented."""
    return (json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode()


def archive(files: Files, top: str) -> bytes:
    """Return a zip file of the files, sorted, in the folder `top`; without dates, and the same on every system."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as target:
        for path in sorted(files):
            entry = zipfile.ZipInfo(f"{top}/{path}")  # its default date is 1980-01-01
            entry.compress_type, entry.create_system, entry.external_attr = zipfile.ZIP_DEFLATED, 3, 0o644 << 16
            target.writestr(entry, files[path], compresslevel=9)
    return buffer.getvalue()
