"""From packets to points: what a sensor's `points` function says, for a batch at a time.

In: `Packets`. Out: a `PointCloud`, whose columns are made when they are read. There are three ways
to compute them, with one meaning:
plainly, by NumPy on a plan, and by compiled kernels. Modules in reading order:

* `conventions`: what the columns mean: axes, ranges, coordinates, types.
* `cloud`: point clouds, where their columns come from, and how a sensor is mounted.
* `colours`: the scale of colours for values, on a dark and on a light ground.
* `look`: how a cloud is looked at: what a picture shows of it, and what its colours stand for.
* `plain`: the reference: `points` evaluated with ordinary NumPy, and its result flattened.
* `windows`: fields by their one or two bytes, and tables of what they can hold.
* `plan`: `points` traced once for a layout, as expressions of the columns.
* `lazy_columns`: the columns of planned points, made when they are asked for.
* `evaluate`: the points of a batch, by plans where there are such, else plainly.
* `numpy_plan`, `numba_kernels`: back ends, each behind one function `compile(plan, ...)`.
"""
