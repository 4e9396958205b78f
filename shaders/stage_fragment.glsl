// A kernel as a fragment shader: the rasteriser calls it once per texel of the viewport.
//
// `origin` is the viewport's corner, so that a kernel can write to a part of a texture.
// Border rule: the viewport is the grid of texels.

uniform ivec2 origin;

void main()
{
    kernel(ivec2(gl_FragCoord.xy) - origin);
}
