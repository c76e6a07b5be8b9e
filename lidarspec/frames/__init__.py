"""Frames and their bytes: field offsets, parsing and building.

The input is the tree of a frame type (`spec.tree`). Modules in reading order:

* `schema`: the fields of a frame type as a table, without bytes.
* `compilability`: finds structs without layouts, whose headers do not determine all offsets.
* `layout`: the offsets of all fields for one header variant (the headers that lead to the same
  offsets), and functions that load and store.
* `measured_size`: sizes that are found by reading the content, such as the size of a text.
* `parts`: searches the parts of many frames (frames within a frame) at once.
* `layout_tree`: the layouts of a frame type, selected by header fields.
* `wire_coder`: converts between a frame on the wire, such as hexadecimal text or escaped bytes, and
  the bytes of its struct.
* `row_checksums`: the checksums of many frames at once.
* `frame_table`: many frames as columns of raw values.
* `parse`: parses one frame.
* `build`: checks the names and values of the fields of one frame, and returns its bytes.
* `encode`: selects the layout for the values, and stores each value at its offset.
* `wire_fields`: finds the fields of one frame with their offsets, even if it is invalid.
* `diagnose`: finds the first fault of a frame.
* `plain`: parses and builds frames that have no layout, with construct.
* `commands`: builds the frame of a command from its arguments.
* `field_paths`: paths of fields as names and indices.
* `wire_table`: the table of a frame type: offsets, widths, units, descriptions.
* `number_format`: physical values as text.
* `arrays`: arrays that need almost no memory, and other array functions.
"""
