"""Subcommands of `featuredb` that `reloc` adds; what they need is imported when they run."""
