"""Messages on the wire: queries and replies, live sessions, what a server says about itself."""
