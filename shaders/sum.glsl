// Sums of square blocks of BLOCK x BLOCK texels.
//
//     total(block) = sum of share over the texels of the block, row by row
//
// Inputs:  share  any unit; one value in each texel
// Outputs: total  unit of the shares; one texel for each block
// Border rule: a block that extends beyond the image adds only its texels inside the image.

void kernel(ivec2 block)
{
    ivec2 first = block * BLOCK;
    ivec2 last = min(first + BLOCK, textureSize(share, 0));
    total = 0.0;
    for (int row = first.y; row < last.y; ++row) {
        float along = 0.0;
        for (int col = first.x; col < last.x; ++col) {
            along += texelFetch(share, ivec2(col, row), 0).x;
        }
        total += along;
    }
}
