"""Slang's `refract` on slangpy's CPU device, which compiles it with g++, in float32, or float64 with that argument."""

import shutil
import sys
from importlib.metadata import version

import numpy as np
import slangpy
import table

SOURCE = """
[shader("compute")] [numthreads(64, 1, 1)]
void refract_rays(uint3 id: SV_DispatchThreadID, uniform uint count,
    StructuredBuffer<FLOAT> ray, RWStructuredBuffer<FLOAT> answer)
{
    uint i = id.x;
    if (i >= count) return;
    vector<FLOAT, 3> a = {ray[7 * i], ray[7 * i + 1], ray[7 * i + 2]};
    vector<FLOAT, 3> n = {ray[7 * i + 3], ray[7 * i + 4], ray[7 * i + 5]};
    vector<FLOAT, 3> b = refract(a, n, ray[7 * i + 6]);
    answer[3 * i] = b.x;
    answer[3 * i + 1] = b.y;
    answer[3 * i + 2] = b.z;
}
"""
precision = sys.argv[1] if len(sys.argv) > 1 else "float32"
rays = table.Rays(precision)
if not shutil.which("g++"):
    print("no g++ for Slang's CPU target; Debian: g++", file=sys.stderr)
    sys.exit(77)
slangpy.Logger.get().remove_all_outputs()  # it would print warnings on stdout
device = slangpy.Device(type=slangpy.DeviceType.cpu)
source = SOURCE.replace("FLOAT", {"float32": "float", "float64": "double"}[precision])
module = device.load_module_from_source("refraction", source)
kernel = device.create_compute_kernel(device.link_program([module], [module.entry_point("refract_rays")]))
rows = np.column_stack([rays.a, rays.n, rays.k]).astype(precision)
usage = slangpy.BufferUsage.shader_resource | slangpy.BufferUsage.unordered_access
ray = device.create_buffer(struct_size=rows.itemsize, element_count=rows.size, usage=usage, data=rows.ravel())
answer = device.create_buffer(struct_size=rows.itemsize, element_count=3 * len(rays), usage=usage)
kernel.dispatch(thread_count=[len(rays), 1, 1], count=len(rays), ray=ray, answer=answer)
b = answer.to_numpy().view(precision).reshape(-1, 3)
table.write(rays, b, f"slangpy {version('slangpy')}, CPU, {precision}")
