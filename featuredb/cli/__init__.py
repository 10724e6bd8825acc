"""The command line: one command `featuredb`, whose subcommands every package adds by an entry point."""
