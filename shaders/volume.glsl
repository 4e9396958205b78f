// Common functions of all kernels for volumes; this text precedes that of each kernel.
//
// A site has one index. Arrays have the layout of the compiled loops, planes of rows of columns
// with a border of void, two sites wide on every side; the index counts along columns first. Each
// component of a field has its own storage buffer, `field[k].at[index]`, in the order of the
// package's arrays: k = 0 is the component along planes, 1 along rows, 2 along columns. All lengths
// are in voxels of the finest level. REAL is float or double, as the kernel requires.
//
// Kernels run on groups with moving sites; in other groups all vectors are 0 (stage_volume.glsl).
//
// Border rule: the border around the grid is void, and 0 in all arrays.

// Number of sites of the level along each axis.
uniform int depth;
uniform int height;
uniform int width;

// Site for which the kernel runs.
int plane;
int row;
int col;

/// Return the distance of indices to the next row, and to the next plane.
int pitch() { return width + 4; }
int stride() { return (height + 4) * pitch(); }

/// Return the index of a site in a level of this height and width.
int number_of(int z, int y, int x, int high, int wide)
{
    return ((z + 2) * (high + 4) + y + 2) * (wide + 4) + x + 2;
}
