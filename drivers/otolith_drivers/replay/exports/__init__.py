"""Tables that programs export in forms of their own: text in blocks, and files of arrays."""
