// The kernels of intersect.cu for the CPU; SOURCE is the path to it, in quotes.
#include "launch.h"

// How often this thread has looked at a node, a triangle, and decided on a triangle.
enum { NODE, TRIANGLE, DECISION, KINDS };
static thread_local long long seen[KINDS];
#define SEEN(what) ++seen[what]
extern "C" const long long* what_was_seen() { return seen; }

#include SOURCE

RUN(cast_table, false)
RUN(cast_bodies, false)
RUN(weigh_table, false)
RUN(pack, true)
