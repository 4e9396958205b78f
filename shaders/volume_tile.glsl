// Displacement of a level that fits into the shared memory of one work group, in voxels.
//
// In kernels that include this file before hexahedra.glsl, elements read `tile` instead of
// `displacement`. The tile contains three consecutive components of TILE values each, which are
// indexed by site.
//
// Border rule: the border around the grid is void, and 0 in the tile.

shared float tile[3 * TILE];

#define DISPLACED(k, number) tile[(k) * TILE + (number)]
