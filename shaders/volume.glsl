// What every kernel for volumes shares; put before the kernel's own text.
//
// A value is addressed by one number: arrays are those of the compiled loops, planes of rows of
// columns with two sites of void on every side, and the number counts along columns first. Each
// component of a field has a storage buffer of its own, `field[k].at[number]`, in the order of the
// package's arrays: k = 0 is the component along planes, 1 along rows, 2 along columns. All lengths
// are in voxels of the finest level. REAL is float, and double where the host would say float64.
//
// Kernels run where something moves, and beyond that every vector holds 0 (stage_volume.glsl).
//
// Border rule: none of its own. What lies beside the grid is void: 0 in every array.

// How many sites the level has.
uniform int depth;
uniform int height;
uniform int width;

// The site that a kernel runs for.
int plane;
int row;
int col;

/// How far the next row is, and the next plane.
int pitch() { return width + 4; }
int stride() { return (height + 4) * pitch(); }

/// The number of a site in a level of this height and width.
int number_of(int z, int y, int x, int high, int wide)
{
    return ((z + 2) * (high + 4) + y + 2) * (wide + 4) + x + 2;
}
