"""Everything that travels, as msgspec tagged structs, a concept a file.

A request is a `Request` header (JSON) and one raw buffer for each entry of `arrays`; its answer
is a `Response` of the same form with the same `id`. Events come on the second endpoint as
``[topic, header, buffers...]``. `docs/protocol.md` is generated from these files.
"""
