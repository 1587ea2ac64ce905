// The kernels of intersect.cu for the CPU; SOURCE is the path to it, in quotes.
#include "launch.h"
#include SOURCE

RUN(cast_table)
RUN(cast_pattern)
RUN(weigh_table)
RUN(count_table)
RUN(count_pattern)
RUN(count_closest)
RUN(pack)
