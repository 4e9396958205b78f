// The vertex shader of every fragment kernel: one triangle that covers the whole viewport, half-way
// into the picture. A kernel that is drawn with a mask runs only where the mask is deeper: it is 1
// in tissue and 0 in void.
//
// Border rule: the triangle's corners lie outside, the rasteriser cuts it to the viewport.

void main()
{
    vec2 corner = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
    gl_Position = vec4(corner, 0.0, 1.0);
}
