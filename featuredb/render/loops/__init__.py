"""Compiled loops of the renderer; import them through `featuredb.render.compiled.compiled_module`."""
