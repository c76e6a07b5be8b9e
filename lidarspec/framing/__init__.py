"""Find the frames in a byte stream or in datagrams.

The frames are returned as `Frames`. All other bytes are counted, and raise no exception. A
*candidate* is an offset at which a frame may start, because the constants of a frame type match
there. Modules in reading order:

* `results`: `Frames`, many frames as arrays; `Found`, one frame; `Counters`.
* `plausibility`: checks many candidates of one layout at once.
* `variable_lengths`: checks candidates of layouts that differ only in the length of an array.
* `frame_codec`: the interface of codecs, which check candidates and make tables of frames.
* `text_frames`: the codec of frames with a wire form.
* `frame_engine`: the codec of binary frames with layouts.
* `plain_frames`: the codec of frames without layouts, which construct parses.
* `weak_frames`: frame types that are accepted only in runs of consecutive frames.
* `candidates`: the candidates of all active types in a piece of a stream.
* `search`: the search of a stream for the leftmost valid candidates.
* `regular_rows`: accepts frames at equal distances without a search.
* `datagram_assembly`: joins messages that are sent in several datagrams.
* `datagrams`: finds the frame type of each datagram.
* `decoder`: `Decoder`, which finds frames as input arrives.
* `example_frames`: valid frames with random content.
"""
