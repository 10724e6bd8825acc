"""Live sessions: a client publishes frames, the server publishes poses. See docs/wire.md."""
