// All smoothing steps of a small level from zero, as one product of a matrix and the load.
//
//     corrected(p) = sum over the pairs q with unknowns of matrix(p, q) load(q)
//
// Inputs:  load    load of the level, pixels times stiffness; pairs
//          matrix  1 / stiffness, in blocks of 4 x 4 values; row `number` belongs to a pair with
//                  unknowns, and texel 4 q + k contains the effect of value k of pair q
//          number  number of each pair with unknowns, -1 for other pairs
//          places  (col, row) of each pair with unknowns, in one row
// Outputs: corrected  correction, pixels; pairs
// Border rule: none needed, because each pair is read once.

void kernel(ivec2 pair)
{
    int row = int(texelFetch(number, clamped(pair, textureSize(load, 0)), 0).x);
    corrected = vec4(0.0);
    if (row < 0) {
        return;
    }
    int count = textureSize(places, 0).x;
    for (int q = 0; q < count; ++q) {
        vec4 by = texelFetch(load, ivec2(texelFetch(places, ivec2(q, 0), 0).xy), 0);
        corrected += by.x * texelFetch(matrix, ivec2(4 * q, row), 0)
            + by.y * texelFetch(matrix, ivec2(4 * q + 1, row), 0)
            + by.z * texelFetch(matrix, ivec2(4 * q + 2, row), 0)
            + by.w * texelFetch(matrix, ivec2(4 * q + 3, row), 0);
    }
}
