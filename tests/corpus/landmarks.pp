<!DOCTYPE PickedPoints>
<PickedPoints>
 <DocumentData>
  <templateName name=""/>
 </DocumentData>
 <point x="-0.4974387480901824" y="0.804872801731112" z="0.0" active="1" name="nose"/>
 <point x="0.0" y="0.5068887828954153" z="0.8201632792408483" active="1" name="left ear"/>
 <point x="0.8416231428390788" y="0.0" z="0.5201517079930583" active="1" name="right ear"/>
 <point x="0.6865867844088583" y="0.4243339689911708" z="0.26225281541768747" active="1" name="tail"/>
</PickedPoints>
