"""From packets to points: what a sensor's `points` function says, for a batch at a time.

In: `Packets`. Out: a `PointCloud`, whose columns are made when they are read. There are three ways
to compute them, with one meaning:
plainly, by NumPy on a plan, and by compiled kernels. Modules in reading order:

* `conventions`: what the columns mean: axes, ranges, coordinates, types.
* `column_sources`: where the columns of consecutive points come from.
* `table_types`: PCL's structured layout and the schema of Arrow.
* `cloud`: point clouds.
* `mount`: how a sensor is mounted on its carrier.
* `colours`: the scale of colours for values, on a dark and on a light ground.
* `look`: how a cloud is looked at: what a picture shows of it, and what its colours stand for.
* `plain`: the reference: `points` evaluated with ordinary NumPy, and its result flattened.
* `windows`: fields by their one or two bytes, and tables of what they can hold.
* `plan`: `points` traced once for a layout, as expressions of the columns.
* `shares`: the packets of one layout in a batch, with their plan and plain results.
* `batch_columns`: the columns of planned points, computed when they are first read.
* `evaluate`: the points of a batch, by plans where there are such, else plainly.
* `numpy_plan`, `numba_kernels`: back ends, each behind one function `compile(plan, names)`.
* `backends`: the choice between them.
"""
