"""Settings that replace those of a scene: the sampler, the integrator, and parameters of `refract_path`.

Example: `sampler=multijitter,integrator=refract_path,split_depth=1`; any of `NAMES`, each once. They replace plugins
and parameters in the parsed scene, not in its file. Parameters that the old and the new plugin share are kept.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from typing import TypeAlias

from mi_refract.plugins import scene_parser
from mi_refract.plugins.scene_parser import Node, ParsedScene

AUTO, OWN = "auto", "the scene's own"
# In the order of preference. `independent` always fits, so a pilot never chooses those after it, see `BIASED`.
SAMPLERS = ("multijitter", "orthogonal", "independent", "stratified", "ldsampler")
INTEGRATORS = ("path", "refract_path")
NAMES = {
    "sampler": "|".join(SAMPLERS),
    "integrator": "|".join(INTEGRATORS),
    "split_depth": "[0-9]|[1-5][0-9]|6[0-4]",  # up to 64, the limit of `refract_path`
    "caustics": "path|lamp|auto",
}
# Mitsuba's samplers with which images by `path` have a bias that the study `samplers` detects.
BIASED = ("stratified", "ldsampler")
_SAMPLER_PARAMETERS = ("sample_count", "seed")  # of every sampler
_TYPES = {"split_depth": "Integer", "caustics": "String"}  # parameters of `refract_path` that can be set
DEFAULTS = {"split_depth": "0", "caustics": "auto"}
_NOT_IN_PATH = (*_TYPES, "split_weight", "light_paths")  # parameters of `refract_path` that `path` does not have
Settings: TypeAlias = dict[str, str]  # by NAMES; {}: the scene's own


def parse_settings(text: str) -> Settings:
    """Return the settings in the order of NAMES: `"split_depth=1"` → `{"split_depth": "1"}`, `OWN` → `{}`.

    ValueError for another syntax.
    """
    settings: Settings = {}
    for item in () if text == OWN else text.split(","):
        name, _, value = item.partition("=")
        if name not in NAMES:
            expected = ", ".join(f"{known}=…" for known in NAMES)
            raise ValueError(f"--settings {text}: {item!r}; expected {AUTO}, or {expected}")
        if not re.fullmatch(NAMES[name], value):
            expected = "0 to 64" if name == "split_depth" else NAMES[name].replace("|", ", ")
            raise ValueError(f"--settings {text}: {name} = {value!r}; expected {expected}")
        if name in settings:
            raise ValueError(f"--settings {text}: {name} is given twice; expected once")
        settings[name] = value
    return {name: settings[name] for name in NAMES if name in settings}


def settings_text(settings: Settings) -> str:
    """Return the text for `parse_settings`, in the order of NAMES, because checkpoints compare texts."""
    return ",".join(f"{name}={settings[name]}" for name in NAMES if name in settings) or OWN


def own_settings(parsed: ParsedScene) -> Settings:
    """Return the scene's own settings; `split_depth` and `caustics` only if its integrator is `refract_path`."""
    sampler, integrator = (_find(parsed.nodes, *path) for path in (("Sensor", "Sampler"), ("Integrator",)))
    own: Settings = {"sampler": "independent" if sampler is None else parsed.nodes[sampler][1]}
    if integrator is not None:
        own["integrator"] = parsed.nodes[integrator][1]
        if own["integrator"] == "refract_path":
            parameters = {name: value for name, _, value in parsed.nodes[integrator][3]}
            own |= {name: str(parameters.get(name, default)) for name, default in DEFAULTS.items()}
    return own


def integrator_node(parsed: ParsedScene, settings: Settings) -> Node | None:
    """Return the scene's integrator with these settings; None if it is none of INTEGRATORS, or contains plugins."""
    number = _find(parsed.nodes, "Integrator")
    if number is None or parsed.nodes[number][1] not in INTEGRATORS:
        return None
    kind, plugin, identifier, parameters = parsed.nodes[number]
    if any(kind == "ResolvedReference" for _, kind, _ in parameters):
        return None
    plugin = settings.get("integrator", plugin)
    changed = [name for name in settings if name in _TYPES]
    dropped = _NOT_IN_PATH if plugin == "path" else changed
    parameters = [parameter for parameter in parameters if parameter[0] not in dropped]
    values = {name: int(settings[name]) if _TYPES[name] == "Integer" else settings[name] for name in changed}
    parameters += [(name, _TYPES[name], value) for name, value in values.items()]
    return kind, plugin, identifier, parameters


def with_settings(parsed: ParsedScene, settings: Settings) -> ParsedScene:
    """Return the parsed scene with these settings. ValueError if they do not suit its integrator."""
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
        if sensor is not None and number is None:  # the sensor would make one by default
            kind, sensor_plugin, identifier, parameters = nodes[sensor]
            nodes[sensor] = kind, sensor_plugin, identifier, [*parameters, ("sampler", "ResolvedReference", len(nodes))]
            nodes.append(("Sampler", plugin, "", []))
        elif number is not None:
            kind, before, identifier, parameters = nodes[number]
            if before != plugin:
                parameters = [parameter for parameter in parameters if parameter[0] in _SAMPLER_PARAMETERS]
            nodes[number] = kind, plugin, identifier, parameters
    return replace(scene_parser.restore(parsed.path, nodes), folders=parsed.folders, named=parsed.named)


def _find(nodes: list[Node], *kinds: str) -> int | None:
    """Follow `kinds` from the scene, each to the first node of that kind. Return its number; None if there is none."""
    parent = 0
    for kind in kinds:
        number = next((child for child in _children(nodes, parent) if nodes[child][0] == kind), None)
        if number is None:
            return None
        parent = number
    return parent


def _children(nodes: list[Node], parent: int) -> Iterator[int]:
    """Yield the numbers of the nodes in a node, with those in shapes: a scene's sensors include those of its shapes."""
    for _, type_, child in nodes[parent][3]:
        if type_ == "ResolvedReference":
            yield child
            if nodes[child][0] == "Shape":
                yield from _children(nodes, child)
