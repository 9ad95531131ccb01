"""Settings that a render may replace in its scene: the sampler, and how `refract_path` traces.

`sampler=multijitter,integrator=refract_path,split_depth=1`: any of `NAMES`, each once. They replace plugins and
parameters in what Mitsuba's parser has read; the file stays as it is. Parameters that both plugins have are kept.
"""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TypeAlias

from mi_refract.plugins import scene_parser
from mi_refract.plugins.scene_parser import Node, ParsedScene

AUTO, OWN = "auto", "the scene's own"
SAMPLERS = ("multijitter", "stratified", "ldsampler", "orthogonal", "independent")  # the first that is as good as any
INTEGRATORS = ("path", "refract_path")
NAMES = {
    "sampler": "|".join(SAMPLERS),
    "integrator": "|".join(INTEGRATORS),
    "split_depth": "[0-9]|[1-5][0-9]|6[0-4]",  # up to 64, as `refract_path` has it
    "caustics": "path|lamp|auto",
}
_SHARED = ("sample_count", "seed")  # parameters of every sampler
_TYPES = {"split_depth": "Integer", "caustics": "String"}  # of `refract_path`; `path` has neither
DEFAULTS = {"split_depth": "0", "caustics": "auto"}
_OWN = (*_TYPES, "split_weight", "light_paths")  # parameters that `path` does not have
Settings: TypeAlias = dict[str, str]  # by NAMES; {}: the scene's own


def parse_settings(text: str) -> Settings:
    """`"split_depth=1"` → `{"split_depth": "1"}`, by NAMES; `OWN` → `{}`. ValueError for another syntax."""
    settings: dict[str, str] = {}
    for item in () if text == OWN else text.split(","):
        name, _, value = item.partition("=")
        if name not in NAMES:
            expected = ", ".join(f"{each}=…" for each in NAMES)
            raise ValueError(f"--settings {text}: {item!r}; expected {AUTO}, or {expected}")
        if not re.fullmatch(NAMES[name], value):
            expected = "0 to 64" if name == "split_depth" else NAMES[name].replace("|", ", ")
            raise ValueError(f"--settings {text}: {name} = {value!r}; expected {expected}")
        if name in settings:
            raise ValueError(f"--settings {text}: {name} is given twice; expected once")
        settings[name] = value
    return {name: settings[name] for name in NAMES if name in settings}


def settings_text(settings: Settings) -> str:
    """What `parse_settings` reads, in the order of NAMES: a checkpoint compares texts."""
    return ",".join(f"{name}={settings[name]}" for name in NAMES if name in settings) or OWN


def own_settings(parsed: ParsedScene) -> Settings:
    """What the scene itself says; `split_depth` and `caustics` only where its integrator is `refract_path`."""
    sampler, integrator = (_find(parsed.nodes, *path) for path in (("Sensor", "Sampler"), ("Integrator",)))
    own: Settings = {"sampler": "independent" if sampler is None else parsed.nodes[sampler][1]}
    if integrator is not None:
        own["integrator"] = parsed.nodes[integrator][1]
        if own["integrator"] == "refract_path":
            given = {name: value for name, _, value in parsed.nodes[integrator][3]}
            own |= {name: str(given.get(name, default)) for name, default in DEFAULTS.items()}
    return own


def integrator_node(parsed: ParsedScene, settings: Settings) -> Node | None:
    """The scene's integrator with these settings; None where it is none of INTEGRATORS, or has plugins within it."""
    number = _find(parsed.nodes, "Integrator")
    if number is None or parsed.nodes[number][1] not in INTEGRATORS:
        return None
    kind, plugin, identifier, parameters = parsed.nodes[number]
    if any(kind == "ResolvedReference" for _, kind, _ in parameters):
        return None
    plugin = settings.get("integrator", plugin)
    changed = [name for name in settings if name in _TYPES]
    dropped = _OWN if plugin == "path" else changed
    parameters = [each for each in parameters if each[0] not in dropped]
    values = {name: int(settings[name]) if _TYPES[name] == "Integer" else settings[name] for name in changed}
    parameters += [(name, _TYPES[name], value) for name, value in values.items()]
    return kind, plugin, identifier, parameters


def with_settings(parsed: ParsedScene, settings: Settings) -> ParsedScene:
    """The scene with these settings, to be loaded. ValueError where its integrator cannot have them."""
    if not settings:
        return parsed
    nodes, what = list(parsed.nodes), f"{parsed.path}: --settings {settings_text(settings)}"
    if settings.keys() - {"sampler"}:
        node, number = integrator_node(parsed, settings), _find(nodes, "Integrator")
        own = own_settings(parsed).get("integrator", "none")
        if node is None or number is None:
            expected = "expected `path` or `refract_path` with numbers as its parameters, or sampler=… alone"
            raise ValueError(f"{what}: the scene's integrator is {own}; {expected}")
        if node[1] == "path" and (foreign := min(settings.keys() & _TYPES.keys(), default="")):
            raise ValueError(f"{what}: `path` has no {foreign}; expected integrator=refract_path")
        nodes[number] = node
    if plugin := settings.get("sampler"):
        sensor, number = _find(nodes, "Sensor"), _find(nodes, "Sensor", "Sampler")
        if sensor is not None and number is None:  # its sensor would make one
            kind, sensor_plugin, identifier, parameters = nodes[sensor]
            nodes[sensor] = kind, sensor_plugin, identifier, [*parameters, ("sampler", "ResolvedReference", len(nodes))]
            nodes.append(("Sampler", plugin, "", []))
        elif number is not None:
            kind, before, identifier, parameters = nodes[number]
            kept = [each for each in parameters if before == plugin or each[0] in _SHARED]
            nodes[number] = kind, plugin, identifier, kept
    return replace(scene_parser.restore(parsed.path, nodes), folders=parsed.folders, named=parsed.named)


def _find(nodes: list[Node], *kinds: str) -> int | None:
    """The number of the first node of a kind in the scene, of the first of the next kind in that, and so on."""
    found = 0
    for kind in kinds:
        inside = (value for _, type_, value in nodes[found][3] if type_ == "ResolvedReference")
        number = next((i for i in inside if nodes[i][0] == kind), None)
        if number is None:
            return None
        found = number
    return found
