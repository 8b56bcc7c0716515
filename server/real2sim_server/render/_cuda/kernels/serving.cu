// The kernels that draw frames for serving, in the order in which they are launched.
//
// Written so that it compiles as C++ as well: the tests run this very source on the CPU.
#include "frame.h"

#include "seen.h"
#include "sort.h"
#include "tiles.h"
#include "blend.h"
