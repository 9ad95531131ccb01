"""A formula of this package in float32 or float64, on compiled arrays; scalar arrays would use double precision."""

import sys

import drjit as dr
import table

from mi_refract import __version__, backend
from mi_refract.accuracy import evaluate
from mi_refract.formulas import FORMULAS
from mi_refract.regimes import Rays

name, precision = sys.argv[1:]
variant = backend.activate()
if variant.startswith("scalar"):
    print("no LLVM and no CUDA: scalar arrays compute in double precision", file=sys.stderr)
    sys.exit(77)
module = getattr(dr, variant.partition("_")[0])
rays = table.Rays(precision)
vector = module.Array3f if precision == "float32" else module.Array3f64
b, transmitted = evaluate(FORMULAS[name], Rays(rays.a, rays.n, rays.k), vector)
table.write(rays, b, f"mi_refract {__version__}, {variant}", transmitted)
