"""The reference pack: scenes, images, rays with certified answers and standard numbers, usable without mi_refract.

`python -m validation pack -o FOLDER` writes it as one archive (`command`, `contents`). `structs` defines its JSON files
and their schemas. `mi_refract.io.reference_pack` reads it. The same versions write the same bytes.
"""
