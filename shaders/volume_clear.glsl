// Buffer filled with zeros, for values of four or eight bytes.
//
//     values[n] = 0
//
// Inputs:  count   number of values of four bytes
// Outputs: values  0 in any type and unit
// Border rule: none needed, because the border is cleared, too.

layout(local_size_x = TOGETHER) in;

uniform int count;

void main()
{
    int group = int(gl_WorkGroupID.x + gl_WorkGroupID.y * gl_NumWorkGroups.x);
    int number = group * TOGETHER + int(gl_LocalInvocationIndex);
    if (number < count) {
        values.at[number] = 0.0;
    }
}
