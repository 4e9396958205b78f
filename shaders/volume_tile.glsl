// The displacement of a level that is small enough for one work group, in memory that it shares.
//
// Kernels that include this before hexahedra.glsl have its elements read `tile` in place of
// `displacement`: one component after the other, TILE values each, by the numbers of sites.
//
// Border rule: what lies beside the grid is void, and 0 in the tile.

shared float tile[3 * TILE];

#define DISPLACED(k, number) tile[(k) * TILE + (number)]
