// All smoothing steps of a small level from zero, as one product of a matrix and the load.
//
//     corrected(p) = sum over the pairs q of matrix(p, q) load(q),    with blocks of 4 x 4 values
//
// Inputs:  load    load of the level, pixels times stiffness; pairs
//          matrix  1 / stiffness; row p belongs to pair p, in row-major order of the pairs, and
//                  texel 4 q + k contains the effect of value k of pair q on the values of pair p
// Outputs: corrected  correction, pixels; pairs
// Border rule: none needed, because each pair is read once.

void kernel(ivec2 pair)
{
    ivec2 size = textureSize(load, 0);
    ivec2 at = clamped(pair, size);
    int number = at.y * size.x + at.x;
    corrected = vec4(0.0);
    int texel = 0;
    for (int row = 0; row < size.y; ++row) {
        for (int col = 0; col < size.x; ++col, texel += 4) {
            vec4 by = texelFetch(load, ivec2(col, row), 0);
            corrected += by.x * texelFetch(matrix, ivec2(texel, number), 0)
                + by.y * texelFetch(matrix, ivec2(texel + 1, number), 0)
                + by.z * texelFetch(matrix, ivec2(texel + 2, number), 0)
                + by.w * texelFetch(matrix, ivec2(texel + 3, number), 0);
        }
    }
}
