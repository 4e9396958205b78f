// Fragment shader of a kernel: the rasterizer runs the kernel once for each texel of the viewport.
//
// Inputs:  origin  position of texel (0, 0) in the output textures, (col, row)
// Border rule: texels outside the viewport are not computed.

uniform ivec2 origin;

void main()
{
    ivec2 at = ivec2(gl_FragCoord.xy) - origin;
#if CARRIES
    enter(at);
#endif
    kernel(at);
}
