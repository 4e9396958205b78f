// Common functions of all kernels for volumes; this text precedes the text of each kernel.
//
// A site has one index. Arrays have the layout of the compiled loops: (plane, row, column) in C
// order, with a border of void, two sites wide on every side. Each component of a field has a
// separate storage buffer, `field[k].at[index]`, in the order of the package's arrays: k = 0 is the
// component along the plane axis, 1 along the row axis, 2 along the column axis. All lengths are in
// voxels of the finest level. REAL is float or double, as the kernel requires. A component of the
// displacement is fixed if it is prescribed or has no elements, and free otherwise.
//
// Kernels run on groups with free sites; in other groups all vectors are 0 (stage_volume.glsl).
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

/// Return the difference of indices to the next row, and to the next plane.
int pitch() { return width + 4; }
int stride() { return (height + 4) * pitch(); }

/// Return the index of a site in a level with the given height and width.
int number_of(int z, int y, int x, int high, int wide)
{
    return ((z + 2) * (high + 4) + y + 2) * (wide + 4) + x + 2;
}
