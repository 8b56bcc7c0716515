// Kernels of cast(), in launch order.
//
// The source also compiles as C++: the tests run it on the CPU.
#include "beams.h"

#include "prepare.h"
#include "tiles.h"
#include "follow.h"
