"""Convert packets to points by the sensor's `points` function, a batch at a time.

`Packets` are converted to a `PointCloud`, which computes each column when it is first read. Three
evaluators give the same columns: the reference evaluator, a NumPy plan, and compiled kernels.

Packets have the same *layout* if their fields are at the same offsets. A *plan* describes how the
points of packets with one layout are computed: for each column, it has an expression of the fields.

Modules in reading order:

* `conventions`: the definitions of axes, ranges, coordinates and types of columns.
* `column_sources`: sources of the columns of consecutive points.
* `table_types`: PCL's structured layout and the schema of Arrow.
* `cloud`: point clouds.
* `firings`: the returns of each firing, and the choice of one.
* `mount`: the position of a sensor on its carrier.
* `colours`: the scale of colours for values, on a dark and on a light background.
* `appearance`: the extent and the colours of a drawn cloud.
* `reference_evaluator`: evaluates `points` with ordinary NumPy; other evaluators must agree.
* `lookup_tables`: the value of an expression for every value of a field of one or two bytes.
* `plan`: traces `points` once for a layout, and makes a plan.
* `layout_groups`: the packets of a batch that have the same layout, with their plan.
* `batch_columns`: the columns of planned points, computed when they are first read.
* `evaluate`: evaluates the points of a batch, by plans if `points` can be traced.
* `numpy_plan`, `numba_kernels`: back ends, each behind one function `compile(plan, names)`.
* `backends`: chooses between the back ends.
"""
