"""HTTP in front of a relocalisation server: OSCP GeoPoseProtocol and plain multipart, asked over Zenoh."""
