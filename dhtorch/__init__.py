"""dhtorch: a short-range depth sensor as a metric ruler."""
