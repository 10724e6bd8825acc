"""Compiled loops of the renderer; import them through `featuredb.compiled.compiled_module`."""
