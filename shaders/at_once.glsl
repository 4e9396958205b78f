// All steps of a small level's smoother at once: from zero they are one matrix times the load.
//
//     corrected(pair) = sum over the pairs q of matrix(pair, q) load(q),    4 x 4 values each
//
// Inputs:  load    what the level is relaxed for, pixels times stiffness; pairs
//          matrix  row p has what pair p gets, pairs counted row by row; its texel 4 q + k has the
//                  answer of the four values to the value k of pair q
// Outputs: corrected  pixels; pairs
// Border rule: none needed, all pairs are read once.

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
