"""OPC UA: a client that subscribes to variables of a server and never writes."""
