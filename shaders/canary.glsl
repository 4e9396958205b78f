// A kernel whose answer is known exactly: it tells a device that computes from one that does not.
//
//     first  = (3 n, n + col, n - row, 2^20 + n) with n the number stored at the mirrored site
//     second = (n / 4, row - col)
//     third  = n / 8 + row col
//
// Small whole numbers and eighths only, so that every operation is exact in float32; it takes a
// read at an unequal address, arithmetic, three outputs and integer coordinates to get it right.
//
// Inputs:  numbers  whole numbers below 1000, no unit
// Outputs: first, second, third  no unit
// Border rule: none needed, the mirrored site lies in the image.

void kernel(ivec2 site)
{
    float n = texelFetch(numbers, textureSize(numbers, 0) - 1 - site, 0).x;
    float row = float(site.y);
    float col = float(site.x);
    first = vec4(3.0 * n, n + col, n - row, 1048576.0 + n);
    second = vec2(0.25 * n, row - col);
    third = 0.125 * n + row * col;
}
