// Kernels that draw frames for serving, in launch order.
//
// The source also compiles as C++: the tests run it on the CPU.
#include "frame.h"

#include "seen.h"
#include "sort.h"
#include "tiles.h"
#include "blend.h"
