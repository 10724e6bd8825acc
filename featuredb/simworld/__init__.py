"""A simulated town with exact truth, looked at by several sensors.

`scene` says what stands where (no pixels), `town` and `blocks` lay one out, `materials` and `ground`
paint its textures, `raster` is the ray-exact camera, `photograph` turns a rendered picture into a photo,
`flight` plans who looks from where, `world` writes files and truth, drawn in a pool of processes.
Every part is deterministic by seed.
"""
