// The vertex shader of every fragment kernel: one triangle that covers the whole viewport.
//
// Border rule: the triangle's corners lie outside, the rasteriser cuts it to the viewport.

void main()
{
    vec2 corner = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
    gl_Position = vec4(corner, 0.0, 1.0);
}
