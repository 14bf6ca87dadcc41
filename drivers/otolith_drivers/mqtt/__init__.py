"""MQTT: a client that subscribes to topics of a broker and never publishes."""
