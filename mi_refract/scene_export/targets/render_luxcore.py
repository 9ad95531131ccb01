"""Render `scene.cfg` with LuxCore: `python render.py --spp 256 --seeds 1 2 3 4 --out .`

It writes one `seedN.exr` per seed. Run this script with a Python that has pyluxcore; mi_refract never imports it.
"""

import argparse
import os
import sys
import time
from pathlib import Path

import pyluxcore


def main():
    """Render once per seed."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--spp", type=int, default=256)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--threads", type=int, default=0, help="0 for all")
    parser.add_argument("--out", type=Path, default=Path())
    options = parser.parse_args()
    out = options.out.resolve()
    os.chdir(Path(__file__).resolve().parent)
    pyluxcore.Init(lambda text: None)
    for seed in options.seeds:
        render(options, seed, out / f"seed{seed}.exr")


def render(options, seed, path):
    """Render `scene.cfg` with this seed into a file."""
    config = pyluxcore.Properties("scene.cfg")
    # LuxCore takes a seed of 0 for 1: both would be the same render.
    overrides = {"batch.haltspp": options.spp, "renderengine.seed": seed + 1, "film.outputs.0.filename": str(path)}
    if options.threads:
        overrides["native.threads.count"] = options.threads
    for key, value in overrides.items():
        config.Set(pyluxcore.Property(key, value))
    scene = pyluxcore.Scene()
    scene.Parse(pyluxcore.Properties("scene.scn"))
    session = pyluxcore.RenderSession(pyluxcore.RenderConfig(config, scene))
    session.Start()
    while not session.HasDone():
        time.sleep(0.05)
        session.UpdateStats()
    session.Stop()
    session.GetFilm().Save()
    print(path, flush=True)


if __name__ == "__main__":
    main()
    sys.stdout.flush()
    os._exit(0)  # a log handler crashes when Python ends normally
