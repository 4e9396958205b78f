// A kernel as a fragment shader: the rasteriser calls it once per texel of the viewport.
//
// `origin` is where texel (0, 0) lies in the written textures; the viewport is the window of texels
// that is run.
// Border rule: nothing outside of the viewport is run.

uniform ivec2 origin;

void main()
{
    ivec2 at = ivec2(gl_FragCoord.xy) - origin;
#if CARRIES
    enter(at);
#endif
    kernel(at);
}
