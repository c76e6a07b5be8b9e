"""A frame and its bytes: where each field stands, frames from values and values from frames.

In: the tree of a frame type (`spec.tree`), and bytes or values. Out: layouts, single frames parsed
and built, tables of many frames.
Modules in reading order:

* `schema`: the fields of a frame type as a table, without bytes.
* `compilability`: what has no computable place, whatever the header.
* `layout`: where each field of one kind of header is, as data; loading by it.
* `parts`: frames within a frame, found from part to part, in many frames at once.
* `layout_tree`: the layouts of a frame type, by the fields of the header that decide.
* `wire_coder`: frames as they are sent, and as the bytes of their structs.
* `row_checksums`: the checksums of many frames at once.
* `frame_table`: many frames as columns of raw values.
* `parse`: one frame from bytes.
* `build`, `encode`: one frame from values: checked, then stored by the layout.
* `wire_fields`: the fields of one frame with their places, also of a damaged one.
* `diagnose`: the first fault of a frame.
* `plain`: frames without a layout, parsed and built by construct.
* `commands`: the frame of a command from its arguments.
* `field_paths`: paths of fields as names and indices.
* `wire_table`: a frame type as people read it: offsets, widths, meanings.
* `arrays`: arrays that cost next to nothing, for all of these.
"""
