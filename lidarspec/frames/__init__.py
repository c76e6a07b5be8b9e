"""Frames and their bytes: field offsets, parsing and building.

In: the tree of a frame type (`spec.tree`), and bytes or values. Out: layouts, single frames parsed
and built, tables of many frames.
Modules in reading order:

* `schema`: the fields of a frame type as a table, without bytes.
* `compilability`: a check for structs that have no layout.
* `layout`: the offsets of all fields for one header variant; loading and storing by them.
* `parts`: frames within a frame, searched in many frames at once.
* `layout_tree`: the layouts of a frame type, selected by header fields.
* `wire_coder`: conversion between frames on the wire and the bytes of their structs.
* `row_checksums`: the checksums of many frames at once.
* `frame_table`: many frames as columns of raw values.
* `parse`: one frame from bytes.
* `build`, `encode`: one frame from values: checks, then stores by the layout.
* `wire_fields`: the fields of one frame with their offsets, also of a damaged one.
* `diagnose`: the first fault of a frame.
* `plain`: frames without a layout, parsed and built by construct.
* `commands`: the frame of a command from its arguments.
* `field_paths`: paths of fields as names and indices.
* `wire_table`: the table of a frame type: offsets, widths, units, descriptions.
* `arrays`: constant and counting arrays without memory, and other array functions.
"""
