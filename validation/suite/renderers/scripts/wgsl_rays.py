"""WGSL's `refract` in a compute shader of wgpu on the first Vulkan adapter: f32, or naga's f64 with `float64`."""

import sys
from importlib.metadata import version

import numpy as np
import table
import wgpu

SOURCE = """
@group(0) @binding(0) var<storage, read> ray: array<FLOAT>;
@group(0) @binding(1) var<storage, read_write> answer: array<FLOAT>;
@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = id.x;
    if (3 * i >= arrayLength(&answer)) { return; }
    let a = vec3<FLOAT>(ray[7 * i], ray[7 * i + 1], ray[7 * i + 2]);
    let n = vec3<FLOAT>(ray[7 * i + 3], ray[7 * i + 4], ray[7 * i + 5]);
    let b = refract(a, n, ray[7 * i + 6]);
    answer[3 * i] = b.x;
    answer[3 * i + 1] = b.y;
    answer[3 * i + 2] = b.z;
}
"""


def refract(device, rows, name):
    """Return b (N, 3) for rows (N, 7) of ray, normal and ratio."""
    usage = wgpu.BufferUsage.STORAGE | wgpu.BufferUsage.COPY_SRC
    rays = device.create_buffer_with_data(data=rows, usage=usage)
    answers = device.create_buffer(size=3 * len(rows) * rows.itemsize, usage=usage)
    module = device.create_shader_module(code=SOURCE.replace("FLOAT", name))
    pipeline = device.create_compute_pipeline(layout="auto", compute={"module": module, "entry_point": "main"})
    entries = [{"binding": i, "resource": {"buffer": buffer}} for i, buffer in enumerate((rays, answers))]
    encoder = device.create_command_encoder()
    step = encoder.begin_compute_pass()
    step.set_pipeline(pipeline)
    step.set_bind_group(0, device.create_bind_group(layout=pipeline.get_bind_group_layout(0), entries=entries))
    step.dispatch_workgroups(-(-len(rows) // 64))
    step.end()
    device.queue.submit([encoder.finish()])
    return np.frombuffer(device.queue.read_buffer(answers), rows.dtype).reshape(-1, 3)


precision = sys.argv[1] if len(sys.argv) > 1 else "float32"
name, features = {"float32": ("f32", []), "float64": ("f64", ["shader-f64"])}[precision]
rays = table.Rays(precision)
try:
    adapters = [
        adapter for adapter in wgpu.gpu.enumerate_adapters_sync() if adapter.info.get("backend_type") == "Vulkan"
    ]
    device = adapters[0].request_device_sync(required_features=features)
except Exception as error:  # any kind: no loader, no adapter, or one without this precision
    print(f"no {precision} by Vulkan ({error!r}); Debian: mesa-vulkan-drivers libvulkan1", file=sys.stderr)
    sys.exit(77)
b = refract(device, np.column_stack([rays.a, rays.n, rays.k]).astype(precision), name)
table.write(rays, b, f"{adapters[0].info['device']}, wgpu {version('wgpu')}, {precision}")
