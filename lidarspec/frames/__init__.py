"""A frame and its bytes: where each field stands, frames from values and values from frames.

In: the tree of a frame type (`spec.tree`), and bytes or values. Out: layouts, single frames parsed
and built, tables of many frames.
Modules in reading order:

* `schema`: the fields of a frame type as a table, without bytes.
* `compilability`: what has no computable place, whatever the header.
* `layout`: where each field of one kind of header is, as data; loading by it.
* `parts`: frames within a frame, found from part to part, in many frames at once.
* `layout_tree`: the layouts of a frame type, by the fields of the header that decide.
* `slots`: frames of a wire form as rows, and back.
* `row_checksums`: the checksums of many frames at once.
* `frame_table`: many frames as columns of raw values.
* `parse`, `build`: one frame from bytes, and one from values.
* `wire_table`: a frame type as people read it: offsets, widths, meanings.
* `arrays`: arrays that cost next to nothing, for all of these.
"""
