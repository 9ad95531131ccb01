"""The reference pack: scenes, images, rays with certified answers and standard numbers, for programs without ours.

`python -m validation pack -o FOLDER` writes it as one archive (`command`, `contents`); `structs` are its JSON files,
from which their schemas are written. `mi_refract.io.reference_pack` reads it back. The same versions give the same
bytes.
"""
