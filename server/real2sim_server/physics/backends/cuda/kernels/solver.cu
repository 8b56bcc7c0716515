// The kernels of the solver, in the order in which they are launched. Before them stand, in what is
// compiled: the type `real`, numbers.h, columns of rows, and the functions shared with the CPU.
//
// Written so that it compiles as C++ as well: the tests run this very source on the CPU.
#include "space.h"

#include "sort.h"
#include "layout.h"
#include "substep.h"
#include "measure.h"
