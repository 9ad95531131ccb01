"""The `refract` of Skia's shading language on the processor: rays and answers are pixels of float32, not colours."""

from importlib.metadata import version

import numpy as np
import skia
import table

SOURCE = """
uniform shader a; uniform shader n; uniform shader k;
float4 main(float2 p) { return float4(refract(a.eval(p).xyz, n.eval(p).xyz, k.eval(p).x), 1); }
"""
WIDTH = 256


def pixels(vectors):
    """(N, 3) or (N, 1) in the first channels of an image."""
    rows = -(-len(vectors) // WIDTH)
    image = np.ones((rows * WIDTH, 4), np.float32)
    image[: len(vectors), : vectors.shape[1]] = vectors
    image = skia.Image.fromarray(
        image.reshape(rows, WIDTH, 4), skia.ColorType.kRGBA_F32_ColorType, skia.AlphaType.kOpaque_AlphaType
    )
    child = image.makeRawShader(skia.TileMode.kClamp, skia.TileMode.kClamp, skia.SamplingOptions())
    return skia.RuntimeEffectChildPtr(child)


rays = table.Rays("float32")
children = skia.VectorRuntimeEffectChildPtr([pixels(x) for x in (rays.a, rays.n, rays.k[:, None])])
effect = skia.RuntimeEffect.MakeForShader(SOURCE)
shader = effect.makeShader(skia.Data.MakeEmpty(), skia.SpanRuntimeEffectChildPtr(children))
kind = skia.ColorType.kRGBA_F32_ColorType, skia.AlphaType.kPremul_AlphaType
info = skia.ImageInfo.Make(WIDTH, -(-len(rays) // WIDTH), *kind)
surface = skia.Surface.MakeRaster(info)
surface.getCanvas().drawPaint(skia.Paint(Shader=shader, BlendMode=skia.BlendMode.kSrc))
answer = np.empty((info.height(), WIDTH, 4), np.float32)
if not surface.readPixels(info, answer, info.minRowBytes(), 0, 0):
    raise SystemExit("Skia: no pixels")
table.write(rays, answer.reshape(-1, 4)[: len(rays), :3], f"Skia, skia-python {version('skia-python')}")
