// The kernels of build.cu for the CPU; SOURCE is the path to it, in quotes.
#include "launch.h"
#include SOURCE

RUN(find_middles)
RUN(encode)
RUN(start_clusters)
RUN(find_partners)
RUN(vote)
RUN(merge)
RUN(join_children)
RUN(place_children)
RUN(open_level)
RUN(next_level)
RUN(write_nodes)
RUN(write_triangles)
