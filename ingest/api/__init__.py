"""A database as Python and the command line use it: `featuredb.open` and what the subcommands run."""
