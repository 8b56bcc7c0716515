// The kernels of cast(), in the order in which they are launched.
//
// Written so that it compiles as C++ as well: the tests run this very source on the CPU.
#include "beams.h"

#include "prepare.h"
#include "tiles.h"
#include "follow.h"
